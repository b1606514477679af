"""The compiled search for poses, and linearised views: nothing outside is read or written, whatever comes."""

import pytest

from camtorch.native.library import library

pytestmark = [pytest.mark.slow, pytest.mark.skipif(library() is None, reason="there is no library")]


def test_no_read_outside_and_nothing_undefined(fuzzed, variant):
    fuzzed("poses_fuzz.c", ["poses.c", "views.c"], variant, 1, 4000)
