"""The tiles of a large floor, fitted by several workers: orders and fits as blobs.

Whoever builds the map puts its order into the blob store and offers it in chunks of tiles. Others take chunks from the
end while it goes on from the beginning, and never waits for them: what they have not brought when nothing else is left
it fits itself. A fit of a tile is the same wherever it is made, so neither is the map any other.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Protocol

import numpy as np

from app.blobs import BlobStore
from app.errors import CorruptArtefact, NotFound, Unavailable
from app.field.hard_iron import HardIron
from app.field.observations import Walk
from app.field.spec import Progress
from app.field.tile_fit import FitState, FitTiles, TileFit, TileOrder
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Tile
from app.services.artefacts import pack, unpack
from app.services.fit_state import state_from_bytes, state_to_bytes

__all__ = ["Board", "fit_chunk", "fit_with_others"]

ALONE_S = 1.0
"""So long one fits alone, to see how long the tiles take: one to sixty milliseconds each, by what they are."""
LEAST_LEFT_S = 3.0
"""Less than that is done before anybody else has begun."""
CHUNK_S = 0.5
_OF_WALKS = ("position_m", "field_uT", "path_m")
_NO_SAMPLES = {"scatter_uT2": np.zeros(0), "sample_field_uT": np.zeros((0, 0)), "stretch_of_sample": np.zeros(0, int)}
"""Tiles are fitted from observations alone."""

_last_order: dict[str, tuple[TileOrder, list[list[Tile]]]] = {}


class Board(Protocol):
    """Where an order stands, and who works on what. Without others nothing is ever taken."""

    def offer(self, order_sha256: str, chunks: int) -> None:
        """Let others take chunks of this order from now on, and of no earlier one."""
        ...

    def begin(self, chunk: int) -> None:
        """Nobody else need take this chunk."""
        ...

    def taken(self) -> Mapping[int, str | None]:
        """The chunks others have taken, with the hash of their fits once they have brought them. Costs nothing."""
        ...

    def withdraw(self) -> None:
        """Nobody need take anything any more, and what was brought can go."""
        ...


def fit_with_others(board: Board, blobs: BlobStore) -> FitTiles:
    """Fits tiles together with whoever takes chunks from the board, where they take long; alone where the blob store is

    away.
    """

    def fit(order: TileOrder, progress: Progress) -> Iterator[tuple[Tile, TileFit]]:
        count, began_s = len(order.tiles), 0.0
        for done, tile in enumerate(order.tiles):
            if done == 1:  # the first may have to be compiled for
                began_s = time.monotonic()
            alone_s = time.monotonic() - began_s
            if done > 1 and alone_s > ALONE_S and alone_s / (done - 1) * (count - done) > LEAST_LEFT_S:
                chunk_tiles = max(1, round(CHUNK_S * (done - 1) / alone_s))
                yield from _fit_together(order, done, chunk_tiles, board, blobs, progress)
                return
            progress(done / count, f"fitting tile {done + 1:,} of {count:,}")
            yield tile, order.fit(tile)

    return fit


def fit_chunk(order_sha256: str, number: int, blobs: BlobStore, progress: Progress) -> dict[str, str]:
    """Fit a chunk of somebody's order and store its fits: `fits_sha256`, or nothing when the order was withdrawn.

    Raises CorruptArtefact when another version of the program made it, Unavailable.
    """
    if order_sha256 not in _last_order:  # whoever fits one chunk of an order fits more of it
        _last_order.clear()
        try:
            _last_order[order_sha256] = _order_from_bytes(blobs.get(order_sha256))
        except NotFound:
            return {}
    order, chunks = _last_order[order_sha256]
    fits, tiles = {}, chunks[number]
    for index, tile in enumerate(tiles):
        progress(index / len(tiles), f"fitting tile {index + 1:,} of {len(tiles):,} for another worker")
        fits[tile] = order.fit(tile)
    return {"fits_sha256": blobs.put(_fits_to_bytes(order, fits))}


def _fit_together(
    order: TileOrder, done: int, chunk_tiles: int, board: Board, blobs: BlobStore, progress: Progress
) -> Iterator[tuple[Tile, TileFit]]:
    """The tiles after the first `done`: those nobody has taken, then what others brought, then what they did not."""
    left = dict(enumerate(_chunks(order.tiles[done:], chunk_tiles)))
    order_sha256 = _offered(order, list(left.values()), board, blobs)
    try:
        while left:
            taken = board.taken()
            chunk = min(left, key=lambda each: (each in taken, taken.get(each) is None, each))
            if chunk not in taken:
                board.begin(chunk)
            fits, tried = dict[Tile, TileFit](), None
            for tile in left[chunk]:
                brought = board.taken().get(chunk)
                if brought != tried and (theirs := _read_fits(brought, left[chunk], blobs)):
                    fits = theirs
                    break
                tried = brought
                place, together = done + len(fits), ", together with other workers" if board.taken() else ""
                progress(place / len(order.tiles), f"fitting tile {place + 1:,} of {len(order.tiles):,}{together}")
                fits[tile] = order.fit(tile)
            yield from fits.items()
            done += len(left.pop(chunk))
    finally:
        board.withdraw()
        with suppress(Unavailable):
            if order_sha256 is not None:
                blobs.discard(order_sha256)


def _offered(order: TileOrder, chunks: list[list[Tile]], board: Board, blobs: BlobStore) -> str | None:
    """The order's hash; None, and nothing offered, where the blob store cannot take it."""
    try:
        order_sha256 = blobs.put(_order_to_bytes(order, chunks))
    except Unavailable:
        return None
    board.offer(order_sha256, len(chunks))
    return order_sha256


def _chunks(tiles: Sequence[Tile], size: int) -> list[list[Tile]]:
    return [list(tiles[start : start + size]) for start in range(0, len(tiles), size)]


def _fits_to_bytes(order: TileOrder, fits: Mapping[Tile, TileFit]) -> bytes:
    fitted = state_to_bytes(FitState(order.learned, order.heights_m, HardIron(), fits), {})
    assert fitted is not None  # a chunk is small
    return fitted


def _read_fits(sha256: str | None, tiles: list[Tile], blobs: BlobStore) -> dict[Tile, TileFit] | None:
    """The fits of these tiles that somebody brought; None when they cannot be read."""
    try:
        fits = dict(state_from_bytes(blobs.get(sha256), {}).tiles) if sha256 else {}
    except (NotFound, CorruptArtefact, Unavailable):
        return None
    return fits if list(fits) == tiles else None


def _order_to_bytes(order: TileOrder, chunks: list[list[Tile]]) -> bytes:
    walks = order.walks.walks
    header = {
        "kind": "tile order",
        "surveys": [walk.survey_id for walk in walks],
        "observations": [len(walk) for walk in walks],
        "resolution_m": order.resolution_m,
        "robust": order.robust,
        "chunks": [[list(tile) for tile in chunk] for chunk in chunks],
    }
    arrays = {name: np.concatenate([getattr(walk, name) for walk in walks]) for name in _OF_WALKS}
    return pack(header, {**arrays, "state": np.frombuffer(_fits_to_bytes(order, {}), np.uint8)})


def _order_from_bytes(data: bytes) -> tuple[TileOrder, list[list[Tile]]]:
    header, arrays = unpack(data, "tile order")
    state = state_from_bytes(arrays["state"].tobytes(), {})
    learned, bounds = state.learned, np.cumsum([0, *header["observations"]]).tolist()
    walks = [
        Walk(survey_id, **{name: arrays[name][start:stop] for name in _OF_WALKS}, **_NO_SAMPLES)
        for survey_id, (start, stop) in zip(header["surveys"], pairwise(bounds), strict=True)
    ]
    chunks = [[Tile(*place) for place in chunk] for chunk in header["chunks"]]
    order = TileOrder(
        TiledWalks(learned.lattice, walks, learned.ambient_uT),
        learned,
        header["resolution_m"],
        state.heights_m,
        header["robust"],
        [tile for chunk in chunks for tile in chunk],
    )
    return order, chunks
