"""Counters of source and sink become events, few enough to read."""

from types import SimpleNamespace

from edgefilter.audio.protocols import Troubles


def test_what_was_lost_since_is_one_event_of_a_kind_and_at_most_one_a_second():
    source, sink = {"lost": 0, "reference_filled": 0, "microphone_overruns": 0}, {"written": 0, "underruns": 0}
    troubles = Troubles(SimpleNamespace(stats=lambda: source), SimpleNamespace(stats=lambda: sink))
    assert troubles(256, False) == []
    source.update(lost=300, reference_filled=300, microphone_overruns=2)
    sink.update(written=5000, underruns=1)
    assert troubles(5000, False) == []
    found = troubles(17_000, False)
    assert [(event.kind, event.sample, event.detail) for event in found] == [
        ("lost", 17_000, "300 reference filled"),
        ("overrun", 17_000, "2 microphone overruns"),
        ("underrun", 17_000, "1 underruns"),
    ]
    source["reference_filled"] += 5
    assert [event.detail for event in troubles(17_001, True)] == ["5 reference filled"]
    assert troubles(50_000, False) == []
