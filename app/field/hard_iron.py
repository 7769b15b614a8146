"""What the sensors themselves put into the samples, taken out before a map is fitted.

A magnetised phone or robot adds a constant to its body frame. Walks that name a calibration session share one, found
where walks meet (`app.field.session_bias`); a walk of no session has its own, found from its turns
(`app.field.body_bias`). What is not known of an offset stays with its survey as a variance.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from app.field.body_bias import BodyBias, estimate_body_bias, remove_body_bias
from app.field.samples import Components, Samples
from app.field.session_bias import estimate_session_biases, offset_variance_uT2, remove_session_biases
from app.geometry import Array

__all__ = ["Cleaned", "HardIron", "remove_hard_iron"]

SIGNIFICANT = 4.0
"""In sds, which are too small by half where attitudes err (clean sensors show up to 2.7 of them): a smaller offset may
be a mistake, and to take it out would make one."""


@dataclass(frozen=True, slots=True, eq=False)
class HardIron:
    """Offsets by session label, and by survey id for surveys of no session; None: nothing can be said of it."""

    sessions: Mapping[str, BodyBias] = field(default_factory=dict)
    surveys: Mapping[str, BodyBias | None] = field(default_factory=dict)

    def as_json(self) -> dict[str, object]:
        """Plain JSON: offsets in the body frame with their sds, uT."""
        known = {name: bias for name, bias in self.surveys.items() if bias is not None}
        return {
            kind: {
                name: {"bias_body_ut": bias.bias_body_uT.tolist(), "sd_ut": bias.sd_uT.tolist()}
                for name, bias in biases.items()
            }
            for kind, biases in (("sessions", self.sessions), ("surveys", known))
        }


@dataclass(frozen=True, slots=True, eq=False)
class Cleaned:
    """walks: without their hard iron; offset_variance_uT2: survey id -> (c,) of what may be left of it."""

    walks: Mapping[str, Samples]
    hard_iron: HardIron
    offset_variance_uT2: Mapping[str, Array]


def remove_hard_iron(walks: Mapping[str, Samples], components: Components, known: HardIron) -> Cleaned:
    """The walks of a floor without the offsets of their sensors. What is `known` already is not estimated again.

    Walks that do not know their attitude are left as they are.
    """
    turned = {name: w for name, w in walks.items() if w.q_body_to_building is not None and w.frame == "building"}
    labels = {str(samples.session) for samples in turned.values() if samples.session is not None}
    sessions = dict(known.sessions)
    if labels - sessions.keys():
        sessions = estimate_session_biases(turned) | sessions
    sessions = {label: sessions[label] for label in sorted(labels & sessions.keys())}
    alone = {name: samples for name, samples in sorted(turned.items()) if samples.session is None}
    surveys = {
        name: known.surveys[name] if name in known.surveys else _significant(estimate_body_bias(samples))
        for name, samples in alone.items()
    }
    cleaned = remove_session_biases(walks, sessions)
    for name, bias in surveys.items():
        if bias is not None:
            cleaned[name] = remove_body_bias(walks[name], bias)
    left = {}
    for name, samples in turned.items():
        offset = surveys.get(name) if samples.session is None else sessions.get(str(samples.session))
        if offset is not None:
            left[name] = offset_variance_uT2(cleaned[name], offset, components).mean(axis=0)
    return Cleaned(cleaned, HardIron(sessions, surveys), left)


def _significant(bias: BodyBias | None) -> BodyBias | None:
    """The offset, if it is larger than its own uncertainty explains."""
    if bias is None:
        return None
    precision = np.linalg.pinv(bias.covariance_uT2, rcond=1e-6, hermitian=True)
    return bias if bias.bias_body_uT @ precision @ bias.bias_body_uT > SIGNIFICANT**2 else None
