"""Orderings as differences with standard errors, and what they say of a claim."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from shockley.compositions import Case, Study, Technique

GOOD_M = 10.0  # a fix is good within this
Measure = Literal["accuracy", "availability"]
Verdict = Literal["AGREES", "DISAGREES", "UNDECIDED", "NOT COMPUTED"]
Rule = Callable[[float, float], Verdict]


class Side(NamedTuple):
    """What is compared: a technique over cases, their fixes taken together."""

    technique: Technique
    cases: tuple[Case, ...]
    measure: Measure = "accuracy"

    def counts(self, study: Study) -> np.ndarray:
        """(worlds, 2): what is counted in each world, and out of how many."""
        out = np.zeros((len(study.worlds), 2))
        for case in self.cases:
            for w, seed in enumerate(study.worlds):
                error = study.errors_m(case, seed)[self.technique]
                fixed = np.isfinite(error)
                counted = error[fixed] < GOOD_M if self.measure == "accuracy" else fixed
                out[w] += counted.sum(), len(counted)
        return out


class Part(NamedTuple):
    """A difference of one check in points, its standard error, and what the claim asks of it."""

    label: str
    points: float
    standard_error: float
    rule: Rule

    @property
    def verdict(self) -> Verdict:
        if not (np.isfinite(self.points) and np.isfinite(self.standard_error)):
            return "NOT COMPUTED"
        return self.rule(self.points, 2.0 * self.standard_error)


class Check(NamedTuple):
    """An ordering of the source; it agrees when all parts do but `exceptions`."""

    claim: str
    citation: str
    parts: list[Part]
    exceptions: int = 0

    @property
    def verdict(self) -> Verdict:
        verdicts = [part.verdict for part in self.parts]
        if "NOT COMPUTED" in verdicts:
            return "NOT COMPUTED"
        if verdicts.count("AGREES") >= len(verdicts) - self.exceptions:
            return "AGREES"
        return "DISAGREES" if verdicts.count("DISAGREES") > self.exceptions else "UNDECIDED"


def above(least: float = 0.0) -> Rule:
    def rule(points: float, doubt: float) -> Verdict:
        return "AGREES" if points - least > doubt else "DISAGREES" if points - least < -doubt else "UNDECIDED"

    return rule


def below(most: float) -> Rule:
    return lambda points, doubt: above(-most)(-points, doubt)


def within(most: float) -> Rule:
    return lambda points, doubt: below(most)(abs(points), doubt)


def contrast(study: Study, *terms: tuple[int, Side]) -> tuple[float, float]:
    """The sum of signed shares in points, and its standard error by leaving out each world in turn."""
    counts = [(sign, side.counts(study)) for sign, side in terms]

    def points(kept: np.ndarray) -> float:
        shares = [(sign, *each[kept].sum(axis=0)) for sign, each in counts]
        return 100.0 * sum(sign * good / total if total else np.nan for sign, good, total in shares)

    worlds = np.arange(len(study.worlds))
    left_out = np.array([points(worlds != w) for w in worlds])
    spread = (len(worlds) - 1) / len(worlds) * np.sum((left_out - left_out.mean()) ** 2)
    return points(worlds >= 0), float(np.sqrt(spread))


def compare(
    study: Study,
    label: str,
    techniques: tuple[Technique, ...],
    better: tuple[Case, ...],
    worse: tuple[Case, ...],
    rule: Rule,
    measure: Measure = "accuracy",
) -> list[Part]:
    """For each technique, one composition less another."""
    return [
        Part(
            " ".join(filter(None, (label, technique, "availability" if measure == "availability" else ""))),
            *contrast(study, (1, Side(technique, better, measure)), (-1, Side(technique, worse, measure))),
            rule,
        )
        for technique in techniques
    ]


def outdo(
    study: Study,
    better: Technique,
    worse: Technique,
    cases: tuple[Case, ...],
    rule: Rule,
    label: str = "",
    measure: Measure = "accuracy",
) -> Part:
    """One technique less another over the same cases."""
    return Part(
        " ".join(filter(None, (label, f"{better} - {worse}", "availability" if measure == "availability" else ""))),
        *contrast(study, (1, Side(better, cases, measure)), (-1, Side(worse, cases, measure))),
        rule,
    )
