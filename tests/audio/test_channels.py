"""Channels as users name them, and which they are among those that are there."""

import argparse

import numpy as np
import pytest

from edgefilter.audio.channels import Channels
from edgefilter.errors import UsageError


@pytest.mark.parametrize(("text", "numbers"), [("2,0", [2, 0]), ("3", [3]), ("all", [0, 1, 2, 3])])
def test_a_command_line_s_channels_are_found_and_can_be_written_again(text, numbers):
    assert Channels.parse(text).among(4, "file") == numbers and str(Channels.parse(text)) == text


@pytest.mark.parametrize("text", ["", "1,1", "-1", "x", "0,1,2,3,4,5,6,7,8"])
def test_what_names_no_microphones_is_no_option(text):
    with pytest.raises(argparse.ArgumentTypeError, match="does not name one to 8 different channels"):
        Channels.parse(text)


def test_a_reference_stays_with_its_microphones_however_they_are_handed_on():
    both = Channels.named([1, 2], 0)
    assert Channels.named(both) is both and Channels.named(Channels([1, 2]), 0) == both
    assert both.among(3, "device") == [1, 2, 0] and Channels.named(None) is None
    np.testing.assert_array_equal(both.taken(np.arange(6.0).reshape(2, 3)), [[1.0, 2.0, 0.0], [4.0, 5.0, 3.0]])
    with pytest.raises(UsageError, match="the microphone has channel 0 alone, found channel 1 asked for"):
        Channels.named([1], there=1)
