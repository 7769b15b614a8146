"""A map whose tiles several workers fitted is the map of one, whatever becomes of the others."""

from pathlib import Path

import numpy as np
import pytest

from app.blobs import FolderBlobStore
from app.errors import CorruptArtefact, JobCancelled
from app.field.fit import fit_map
from app.field.samples import Samples
from app.field.spec import FittedMap, MapSpec, Progress
from app.services import shared_tiles
from app.services.artefacts import grid_to_bytes
from app.services.fit_state import state_to_bytes
from app.services.shared_tiles import fit_chunk, fit_with_others

SPECS = {
    "plane": MapSpec(resolution_m=0.5),
    "robust": MapSpec(resolution_m=0.5, robust=True, components="norm"),
    "potential": MapSpec(resolution_m=0.5, curl_free=True, noise="white"),
}


class Said:
    """Progress that is written down: a message for every tile that is fitted here."""

    def __init__(self) -> None:
        self.tiles: list[str] = []

    def __call__(self, _fraction: float, message: str) -> None:
        if message.startswith("fitting tile"):
            self.tiles.append(message)


def quiet(fraction: float, message: str) -> None:
    """Progress that nobody follows."""


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ALONE_S", "LEAST_LEFT_S", "CHUNK_S"):
        monkeypatch.setattr(shared_tiles, name, 0.0)


@pytest.fixture(scope="module")
def walks() -> dict[str, Samples]:
    rng = np.random.default_rng(3)
    walks = {}
    for number in range(3):
        along = np.linspace(0.0, 1.0, 400)
        x, y = 14.0 * along, 4.0 + 3.5 * np.sin(5.0 * np.pi * along + number)
        p = np.stack([x, y, np.zeros_like(x)], axis=1)
        waves = [8.0 * np.sin(x / 1.7 + c) * np.cos(y / 1.3 - c) for c in range(3)]
        B = np.array([18.0, 3.0, -44.0]) + np.stack(waves, axis=1) + rng.normal(0.0, 0.2, p.shape)
        walks[f"walk-{number}"] = Samples(np.arange(400.0), p, B, "building")
    return walks


class Others:
    """A board whose others do as told about each chunk, as soon as it is offered.

    brings: chunks that are fitted at once; takes: chunks that are taken and never brought; lies: brought are fits of
    other tiles, nothing, and something else.
    """

    def __init__(self, blobs: FolderBlobStore, brings: range, takes: range = range(0), lies: bool = False) -> None:
        self._blobs, self._brings, self._takes, self._lies = blobs, brings, takes, lies
        self._taken: dict[int, str | None] = {}
        self.offers: list[str] = []
        self.begun: list[int] = []
        self.open = False

    def offer(self, order_sha256: str, chunks: int) -> None:
        self.offers.append(order_sha256)
        self.open, self._taken, self.begun = True, {}, []
        for chunk in range(chunks):
            if chunk in self._brings:
                fitted = (chunk + 1) % chunks if self._lies else chunk
                self._taken[chunk] = fit_chunk(order_sha256, fitted, self._blobs, quiet)["fits_sha256"]
            elif chunk in self._takes:
                self._taken[chunk] = None
        if self._lies:
            self._taken |= {0: "0" * 64, 1: self._blobs.put(b"no fits")}

    def begin(self, chunk: int) -> None:
        self.begun.append(chunk)

    def taken(self) -> dict[int, str | None]:
        return self._taken

    def withdraw(self) -> None:
        self.open = False
        for sha256 in filter(None, self._taken.values()):
            self._blobs.discard(sha256)


def fitted(
    walks: dict[str, Samples], spec: MapSpec, board: Others, blobs: FolderBlobStore, progress: Progress = quiet
) -> FittedMap:
    return fit_map(walks, spec, progress, fit_tiles=fit_with_others(board, blobs))


def same(one: FittedMap, other: FittedMap) -> bool:
    states = [state_to_bytes(each.state, {}) for each in (one, other) if each.state]
    return grid_to_bytes(one.grid) == grid_to_bytes(other.grid) and states[0] == states[1]


@pytest.mark.parametrize("name", SPECS)
def test_tiles_that_others_brought_are_those_one_would_fit_oneself(
    name: str, walks: dict[str, Samples], blob_store: FolderBlobStore
) -> None:
    alone, said = fit_map(walks, SPECS[name]), Said()
    others = Others(blob_store, brings=range(2, 100))
    together = fitted(walks, SPECS[name], others, blob_store, said)
    assert others.begun == [0, 1]
    assert len(said.tiles) == len(others.offers) * 4  # two to see how long they take, and two that nobody took
    assert same(together, alone)
    assert not others.open
    assert list(blob_store.stored()) == []


def test_what_others_do_not_bring_or_bring_wrongly_is_fitted_here(
    walks: dict[str, Samples], blob_store: FolderBlobStore
) -> None:
    alone = fit_map(walks, SPECS["plane"])
    for others in (
        Others(blob_store, brings=range(0)),
        Others(blob_store, brings=range(2, 3), takes=range(100)),
        Others(blob_store, brings=range(100), lies=True),
    ):
        assert same(fitted(walks, SPECS["plane"], others, blob_store), alone)
        assert not others.open


def test_a_fit_that_is_cancelled_takes_its_offer_back(walks: dict[str, Samples], blob_store: FolderBlobStore) -> None:
    others = Others(blob_store, brings=range(3, 100))

    def cancel(_fraction: float, message: str) -> None:
        if "together with other workers" in message:
            raise JobCancelled("the job was asked to stop")

    with pytest.raises(JobCancelled):
        fit_map(walks, SPECS["plane"], cancel, fit_tiles=fit_with_others(others, blob_store))
    assert not others.open
    assert list(blob_store.stored()) == []
    assert fit_chunk(others.offers[0], 0, blob_store, quiet) != {}  # as long as it is remembered
    assert fit_chunk("f" * 64, 0, blob_store, quiet) == {}


def test_a_store_that_takes_no_order_costs_the_help_of_others_alone(
    walks: dict[str, Samples], blob_store: FolderBlobStore, tmp_path: Path
) -> None:
    others = Others(blob_store, brings=range(100))
    (tmp_path / "blobs").rename(tmp_path / "away")
    together = fitted(walks, SPECS["plane"], others, blob_store)
    assert others.offers == []
    assert same(together, fit_map(walks, SPECS["plane"]))


def test_what_is_soon_done_is_not_offered(
    walks: dict[str, Samples], blob_store: FolderBlobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_tiles, "LEAST_LEFT_S", 1000.0)
    others = Others(blob_store, brings=range(100))
    fitted(walks, SPECS["plane"], others, blob_store)
    assert others.offers == []


def test_an_order_of_another_version_is_left_alone(
    walks: dict[str, Samples], blob_store: FolderBlobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders: list[bytes] = []

    class Keeping(Others):
        def offer(self, order_sha256: str, chunks: int) -> None:
            orders.append(blob_store.get(order_sha256))

    fitted(walks, SPECS["plane"], Keeping(blob_store, brings=range(0)), blob_store)
    monkeypatch.setattr("app.services.fit_state._VERSION", "0.0.0-1")
    with pytest.raises(CorruptArtefact, match="was written by version"):
        fit_chunk(blob_store.put(orders[0]), 0, blob_store, quiet)
