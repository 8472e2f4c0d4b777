"""A remembered search is the search."""

from __future__ import annotations

import numpy as np
import pytest

from slamfusion.align.pair import Pair
from slamfusion.align.search import search
from slamfusion.align.shifts import SearchWindow
from slamfusion.compute import open_device
from tests.fusion.drawings import building, features_of, fusion_config
from tests.support.searches import RememberedSearches

pytestmark = pytest.mark.once


def test_the_same_question_is_asked_once_and_another_one_anew() -> None:
    device, config = open_device(), fusion_config().align
    a, b, other = (features_of(building(seed, 7.0, 6.0), device) for seed in (3, 3, 4))
    remembered = RememberedSearches()
    for made, question in ((1, (a, b)), (1, (b, a)), (2, (a, other)), (3, (other, a))):
        _, motions, scores = remembered(Pair(*question), config, SearchWindow())
        _, wanted, of = search(Pair(*question), config, SearchWindow())
        assert np.array_equal(motions, wanted)
        assert np.array_equal(scores, of)
        motions += 1.0  # nobody changes what is remembered
        assert remembered.made == made
