"""The benchmark of a stranger's phone in small: an offset that is integrated out does not matter."""

from dataclasses import replace

import numpy as np
import pytest


@pytest.fixture(scope="module")
def strangers_phone(benchmark_named):
    return benchmark_named("strangers_phone")


def test_every_phone_has_an_offset_of_its_own_of_the_same_size(strangers_phone):
    rng = np.random.default_rng(0)
    offsets = np.array([strangers_phone.stranger(rng, 10.0).hard_iron_uT for _ in range(200)])
    assert np.allclose(np.linalg.norm(offsets, axis=1), 10.0)
    assert np.linalg.norm(offsets.mean(axis=0)) < 2.0


def test_windows_are_asked_every_way_and_found_without_their_offset(strangers_phone, small_building):
    building, floors = small_building
    answers = strangers_phone.located(building, floors, 2, np.random.default_rng(0))
    assert [each.way for each in answers] == 2 * [way.name for way in strangers_phone.WAYS]
    treated = {way.name for way in strangers_phone.WAYS if way.has_target}
    assert all(each.within for each in answers if each.way in treated)
    assert strangers_phone.report(answers) in (0, 1)


@pytest.mark.parametrize(
    ("within", "wrong_fixes", "failed"), [(100, 0, 0), (98, 1, 0), (98, 2, 1), (97, 0, 1)]
)  # of a hundred
def test_only_the_ways_with_a_target_decide(strangers_phone, within, wrong_fixes, failed):
    good = strangers_phone.Answer("", True, True, True, 0.1, 0.01)
    bad = replace(good, within=False, held=False, error_m=9.0)
    missed = [replace(bad, is_fix=k < wrong_fixes) for k in range(100 - within)]
    answers = []
    for way in strangers_phone.WAYS:
        answers += [
            replace(each, way=way.name) for each in (within * [good] + missed if way.has_target else 100 * [bad])
        ]
    assert strangers_phone.report(answers) == failed
