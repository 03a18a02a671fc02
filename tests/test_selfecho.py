"""A recogniser's words held against the robot's own."""

import pytest

from edgefilter.errors import UsageError
from edgefilter.selfecho import Said, normalise, score

SAID = "The museum opens at nine. On Mondays it stays closed, but the garden behind the house is open all day."


def test_the_robots_own_sentence_misheard_is_found_and_another_is_not():
    assert score("on mandays it stays close, but the garden behind a house is open", SAID) > 0.9
    assert score("I would rather hear something about the weather in Lisbon", SAID) < 0.2


def test_case_accents_and_punctuation_do_not_count():
    assert normalise("  L\u2019Été: it's 3-4 o'clock ") == "lete its 3 4 oclock"
    assert score("DAS MÜSLI, BITTE!", "das musli bitte") == 1.0


def test_words_of_both_are_counted_by_their_letters():
    own, human = "the garden behind the house", "please tell grandmother about tickets"
    part = sum(map(len, own.split())) / sum(map(len, (own + " " + human).split()))
    # a letter or two of the human's may be found beside the passage: a word more or less
    assert score(f"{human} {own}", SAID) == pytest.approx(part, abs=0.1)
    assert score(f"{own} {human}", SAID) == pytest.approx(part, abs=0.1)


def test_the_order_of_the_robots_sentences_does_not_matter():
    assert score("it stays closed the museum opens at nine", SAID) == 1.0


def test_little_words_in_common_are_no_evidence():
    assert score("and the", "and then there were the others") == 0.0
    assert score("is it the one on the left", SAID) < 0.4


def test_a_short_answer_has_to_be_found_whole():
    assert score("nine", SAID) == 1.0
    assert score("in", SAID) == 0.0  # inside "behind", which is another word
    assert score("no", SAID) == 0.0


def test_what_the_robot_said_long_ago_does_not_count():
    said = [Said("the museum opens at nine", 0.0, 2.0), Said("anything else", 20.0, 21.0)]
    assert score("the museum opens at nine", said, heard=(0.5, 2.5)) == 1.0
    assert score("the museum opens at nine", said, heard=(20.5, 22.0)) == 0.0
    assert score("the museum opens at nine", said) == 1.0
    assert score("the museum opens at nine", ["the museum opens at nine"], heard=(20.5, 22.0)) == 1.0


def test_a_human_who_repeats_the_robots_words_is_told_by_the_probability_of_speech():
    words = "the museum opens at nine"
    sure, unsure, nobody = (score(words, SAID, speech_probability=p) for p in (0.99, 0.5, 0.01))
    assert sure < unsure < nobody
    assert unsure == pytest.approx(0.98) and sure == pytest.approx(0.5)


def test_nothing_heard_or_nothing_said_is_no_echo():
    assert score("", SAID) == score("?!", SAID) == score("hello", "") == score("hello", []) == 0.0
    assert score("", SAID, speech_probability=0.0) == 0.0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"heard": (2.0, 1.0)}, r"heard is \(2.0, 1.0\), expected"),
        ({"heard": (float("nan"), 1.0)}, "heard is"),
        ({"speech_probability": 1.5}, "speech_probability is 1.5, expected 0 to 1"),
        ({"speech_probability": float("nan")}, "speech_probability is nan"),
    ],
)
def test_what_means_nothing_is_one_line(more, message):
    with pytest.raises(UsageError, match=message):
        score("hello", "hello", **more)
