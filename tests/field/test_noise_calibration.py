import numpy as np
import pytest

from app.field.noise_calibration import LEAST_SHARE, noise_sd_by_survey, noise_sd_shown

BELIEVED = np.array([0.1, 1.3])


def needed(rng, noise_sd, surveys=4, n=3000, latent=0.25):
    errors = {str(s): rng.normal(0.0, np.sqrt(latent + np.square(noise_sd)), (n, 2)) for s in range(surveys)}
    return {name: np.square(e) / 4.0 - latent for name, e in errors.items()}


def test_noise_is_what_held_out_errors_show_whatever_was_believed():
    shown = noise_sd_shown(list(needed(np.random.default_rng(0), 1.0, surveys=40, n=300).values()), BELIEVED)
    assert shown == pytest.approx([1.0, 1.0], rel=0.05)


def test_few_surveys_leave_the_belief_alone():
    few = needed(np.random.default_rng(0), 1.0, surveys=2)
    assert np.array_equal(noise_sd_shown(list(few.values()), BELIEVED), BELIEVED)
    assert np.array_equal(noise_sd_shown([np.zeros((0, 2))] * 5, BELIEVED), BELIEVED)


def test_a_survey_is_not_scored_with_its_own_errors():
    all_needed = needed(np.random.default_rng(0), 1.0, surveys=40, n=300)
    all_needed["0"] = all_needed["0"] + 100.0
    assert noise_sd_by_survey(all_needed, BELIEVED)["0"] == pytest.approx([1.0, 1.0], rel=0.05)


def test_sparse_surveys_do_not_talk_the_noise_away():
    """Where the latent variance is overstated, errors ask for no noise at all: most of the belief stays."""
    overstated = {name: n - 2.0 for name, n in needed(np.random.default_rng(0), 1.0).items()}
    shown = noise_sd_shown(list(overstated.values()), BELIEVED)
    assert shown == pytest.approx(LEAST_SHARE * BELIEVED)


def test_the_noise_for_a_survey_is_what_the_others_show_alone():
    rng = np.random.default_rng(3)
    needed = {str(k): np.round(rng.normal(1.0, 1.0, (n, 2)), 1) for k, n in enumerate((300, 1, 0, 450, 120, 80))}
    believed = np.array([0.5, 0.1])
    by_survey = noise_sd_by_survey(needed, believed)
    for survey_id, sd in by_survey.items():
        alone = noise_sd_shown([n for other, n in needed.items() if other != survey_id], believed)
        assert np.allclose(sd, alone, rtol=1e-12), survey_id


def test_new_surveys_are_covered_as_stated_when_each_has_its_own_scale():
    """Few surveys, whose errors are common to much of them: what is set on them covers the next ones."""
    rng = np.random.default_rng(1)
    covered = []
    for _ in range(150):
        scale = np.exp(0.5 * rng.standard_normal(13))
        errors = scale[:, None, None] * (rng.standard_normal((13, 12, 1)) + 0.5 * rng.standard_normal((13, 12, 40)))
        seen = [np.square(e.reshape(-1, 1)) / 4.0 for e in errors[:12]]
        sd = noise_sd_shown(seen, np.array([1e-3]))
        covered.append(np.mean(np.abs(errors[12]) <= 2.0 * sd))
    assert np.mean(covered) == pytest.approx(0.9545, abs=0.015)
