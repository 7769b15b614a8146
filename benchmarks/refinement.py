"""Maps of refined walks against maps of the same walks as they are, forced even where the proof speaks against it.

Without a folder: an analytic building whose field is known, walked eight times with labels off by 0.35 m per axis,
smooth over 7 m of the path, at steel of three strengths; judged by the known field. With a folder (a folder per floor,
walks of format indoor-location-2020): one walk in five held out, and not used by the refinement in any way; judged by
those.

    python benchmarks/refinement.py [FOLDER] [FLOOR ...]    exits 1 where refinement is applied and judged to be worse
"""

import gzip
import sys
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from app.field.fit import fit_map
from app.field.hard_iron import Cleaned, HardIron
from app.field.label_errors import LABEL_SD_M, label_prior
from app.field.refinement import Refinement, refine
from app.field.samples import Samples
from app.field.session_bias import estimate_session_biases
from app.field.spec import MapSpec
from app.services.held_out_walks import WALK_SUFFIXES, calibrate_sessions, hold_out
from app.services.map_scores import held_out_walk, nlpd_gain, score_map
from app.survey.read import read_survey
from app.synthetic.building import make_building
from app.synthetic.walks import random_waypoints

SPEC = MapSpec(resolution_m=0.5, hard_iron=False)
WALKS, WALK_M, LABEL_ERROR_M, NOISE_UT = 8, 60.0, 0.35, 0.3
STRENGTHS_UT = (5.0, 1.0, 0.1)


def refined(walks: dict[str, Samples]) -> Refinement:
    found = refine(Cleaned(walks, HardIron(), {}), SPEC, lambda fraction, message: None)
    report = found.as_json()
    rms_m = np.sqrt(np.mean(np.square(list(found.correction_rms_m.values()))))
    print(f"  applied: {report['applied']} ({report['reason']})")
    print(
        f"  variance of known errors that comes out: {found.recovered_share or 0.0:.2f}; corrections {rms_m:.2f} m rms"
    )
    for name, gain in (
        ("untouched walks, nats per observation", found.untouched_nats),
        ("untouched walks, error falls by", found.untouched_error),
        ("unseen components, error falls by", found.unseen_error),
    ):
        if gain is not None:
            print(f"  {name}: {gain.value:+.3f} ±{gain.standard_error:.3f} ({gain.walks} walks)")
    return found


def known_field(strength_uT: float) -> bool:
    rng = np.random.default_rng(1)
    building = make_building(rng, width_m=14.0, depth_m=12.0, floors=1, field_sd_uT=strength_uT)
    walks = {}
    for index in range(WALKS):
        planned = random_waypoints(building, 0, rng, length_m=WALK_M)
        right_m, functions = planned.p_building_m, label_prior(planned.path_length_m())
        error_m = LABEL_ERROR_M / LABEL_SD_M * functions @ rng.normal(size=(functions.shape[1], 2))
        B_uT = building.field_uT(right_m) + NOISE_UT * rng.normal(size=right_m.shape)
        labels_m = right_m + np.pad(error_m, ((0, 0), (0, 1)))
        walks[f"walk-{index}"] = Samples(planned.t_s, labels_m, B_uT, "building")
    print(f"field sd {strength_uT:g} uT")
    found = refined(walks)
    at_m = building.device_grid_m(0, 0.5).reshape(-1, 3)
    rmse_uT = []
    for each in (walks, found.walks):
        values = fit_map(each, SPEC).grid.at(at_m)
        rmse_uT.append(np.sqrt(np.mean(np.square(values.mean_uT - building.field_uT(at_m))[values.measured])))
    print(
        f"  RMSE against the known field {rmse_uT[0]:.3f} -> {rmse_uT[1]:.3f} uT, ratio {rmse_uT[1] / rmse_uT[0]:.2f}"
    )
    return not found.worth_it or rmse_uT[1] < rmse_uT[0]


def _bytes(file: Path) -> bytes:
    return gzip.decompress(file.read_bytes()) if file.suffix == ".gz" else file.read_bytes()


def real_floor(folder: Path) -> bool:
    files = [file for file in sorted(folder.iterdir()) if file.name.endswith(WALK_SUFFIXES)]
    read = {file.name: read_survey(_bytes(file), format="indoor-location-2020") for file in files}
    mapping, held_out = hold_out(read)
    biases = estimate_session_biases({name: read[name].samples for name in mapping})
    read = calibrate_sessions(read, biases)
    walks = {name: read[name].samples for name in mapping}
    print(f"{folder.name}: {len(mapping)} walks, {len(held_out)} held out")
    found = refined(walks)
    mapped_m = np.concatenate([samples.p_building_m[:, :2] for samples in walks.values()])
    judged = []
    for each in (walks, found.walks):
        grid = fit_map(each, SPEC).grid
        judged.append([held_out_walk(grid, read[name].samples, mapped_m, None) for name in held_out])
        if score := score_map(judged[-1]):
            robust = " / ".join(x.text(2) for x in score.robust_sd_ut)
            rmse = " / ".join(f"{x:.2f}" for x in score.rmse_ut)
            print(f"  held-out walks: RMSE {rmse}, robust sd {robust} uT, NLPD {score.nlpd.text(2)}")
    gain = nlpd_gain(judged[1], judged[0])
    print(f"  NLPD of held-out walks falls by {gain.text(3) if gain else '-'}")
    return not found.worth_it or gain is None or gain.value > -2.0 * (gain.standard_error or np.inf)


def main(arguments: list[str]) -> int:
    if arguments:
        folders = sorted(path for path in Path(arguments[0]).iterdir() if path.is_dir())
        passed = [real_floor(path) for path in folders if path.name in (arguments[1:] or [path.name])]
    else:
        passed = [known_field(strength) for strength in STRENGTHS_UT]
    print("PASS" if all(passed) else "FAIL")
    return 0 if all(passed) else 1


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main(sys.argv[1:]))
