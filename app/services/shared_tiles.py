"""The tiles of a large floor, fitted by several workers: orders and fits as blobs.

Whoever builds the map puts its order into the blob store and offers it in chunks of tiles. Others take chunks from the
end while it goes on from the beginning, and never waits for them: what they have not brought when nothing else is left
it fits itself. A fit of a tile is the same wherever it is made, so neither is the map any other.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import pairwise
from typing import Protocol

import numpy as np

from app.blobs import BlobStore
from app.errors import CorruptArtefact, NotFound, Unavailable
from app.field.hard_iron import HardIron
from app.field.observations import Walk
from app.field.spec import Progress
from app.field.tile_fit import FitState, FitTiles, TileFit, TileOrder, fit_one_by_one
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Tile
from app.services.artefacts import pack, unpack
from app.services.fit_state import state_from_bytes, state_to_bytes

__all__ = ["LEAST_TILES", "Board", "fit_chunk", "fit_with_others"]

LEAST_TILES = 768
"""Fewer are fitted in two or three seconds, before anybody else has begun."""
CHUNK_TILES = 128
_OF_WALKS = ("position_m", "field_uT", "path_m")
_NO_SAMPLES = {"scatter_uT2": np.zeros(0), "sample_field_uT": np.zeros((0, 0)), "stretch_of_sample": np.zeros(0, int)}
"""Tiles are fitted from observations alone."""

_last_order: dict[str, TileOrder] = {}


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
        """Nobody need take anything any more."""
        ...


def fit_with_others(board: Board, blobs: BlobStore) -> FitTiles:
    """Fits the tiles of large orders together with whoever takes chunks from the board.

    Raises Unavailable where the blob store is away.
    """

    def fit(order: TileOrder, progress: Progress) -> Iterable[tuple[Tile, TileFit]]:
        if len(order.tiles) < LEAST_TILES:
            return fit_one_by_one(order, progress)
        return _fit_together(order, board, blobs, progress)

    return fit


def fit_chunk(order_sha256: str, number: int, blobs: BlobStore, progress: Progress) -> dict[str, str]:
    """Fit a chunk of somebody's order and store its fits: `fits_sha256`. Raises NotFound when the order is withdrawn,

    CorruptArtefact when another version of the program made it.
    """
    if order_sha256 not in _last_order:  # whoever fits one chunk of an order fits more of it
        _last_order.clear()
        _last_order[order_sha256] = _order_from_bytes(blobs.get(order_sha256))
    order = _last_order[order_sha256]
    fits, tiles = {}, _chunks(order)[number]
    for index, tile in enumerate(tiles):
        progress(index / len(tiles), f"fitting tile {index + 1:,} of {len(tiles):,} for another worker")
        fits[tile] = order.fit(tile)
    return {"fits_sha256": blobs.put(_fits_to_bytes(order, fits))}


def _fit_together(
    order: TileOrder, board: Board, blobs: BlobStore, progress: Progress
) -> Iterator[tuple[Tile, TileFit]]:
    """What nobody has taken first, then what others have brought, then what they have not."""
    left = dict(enumerate(_chunks(order)))
    order_sha256 = blobs.put(_order_to_bytes(order))
    board.offer(order_sha256, len(left))

    def place(chunk: int) -> tuple[bool, bool, int]:
        taken = board.taken()
        return chunk in taken, taken.get(chunk) is None, chunk

    def say(done: int) -> None:
        together = ", together with other workers" if board.taken() else ""
        progress(done / len(order.tiles), f"fitting tile {done + 1:,} of {len(order.tiles):,}{together}")

    try:
        done = 0
        while left:
            chunk = min(left, key=place)
            board.begin(chunk)
            fits, tried = dict[Tile, TileFit](), None
            for tile in left[chunk]:
                brought = board.taken().get(chunk)
                if brought != tried and (theirs := _read_fits(brought, left[chunk], blobs)):
                    fits = theirs
                    break
                tried = brought
                say(done + len(fits))
                fits[tile] = order.fit(tile)
            yield from fits.items()
            done += len(left.pop(chunk))
    finally:  # of a worker that is killed they stay, for the one that takes over
        used = {order_sha256, *filter(None, board.taken().values())}
        board.withdraw()
        with suppress(Unavailable):
            for sha256 in used:
                blobs.discard(sha256)


def _chunks(order: TileOrder) -> list[list[Tile]]:
    tiles = list(order.tiles)
    return [tiles[start : start + CHUNK_TILES] for start in range(0, len(tiles), CHUNK_TILES)]


def _fits_to_bytes(order: TileOrder, fits: Mapping[Tile, TileFit]) -> bytes:
    fitted = state_to_bytes(FitState(order.learned, order.heights_m, HardIron(), fits), {})
    assert fitted is not None  # a chunk is small
    return fitted


def _read_fits(sha256: str | None, tiles: list[Tile], blobs: BlobStore) -> dict[Tile, TileFit] | None:
    """The fits of these tiles that somebody brought; None when they cannot be read."""
    try:
        fits = dict(state_from_bytes(blobs.get(sha256), {}).tiles) if sha256 else {}
    except (NotFound, CorruptArtefact):
        return None
    return fits if list(fits) == tiles else None


def _order_to_bytes(order: TileOrder) -> bytes:
    walks = order.walks.walks
    header = {
        "kind": "tile order",
        "surveys": [walk.survey_id for walk in walks],
        "observations": [len(walk) for walk in walks],
        "resolution_m": order.resolution_m,
        "robust": order.robust,
        "tiles": [list(tile) for tile in order.tiles],
    }
    arrays = {name: np.concatenate([getattr(walk, name) for walk in walks]) for name in _OF_WALKS}
    return pack(header, {**arrays, "state": np.frombuffer(_fits_to_bytes(order, {}), np.uint8)})


def _order_from_bytes(data: bytes) -> TileOrder:
    header, arrays = unpack(data, "tile order")
    state = state_from_bytes(arrays["state"].tobytes(), {})
    learned, bounds = state.learned, np.cumsum([0, *header["observations"]]).tolist()
    walks = [
        Walk(survey_id, **{name: arrays[name][start:stop] for name in _OF_WALKS}, **_NO_SAMPLES)
        for survey_id, (start, stop) in zip(header["surveys"], pairwise(bounds), strict=True)
    ]
    return TileOrder(
        TiledWalks(learned.lattice, walks, learned.ambient_uT),
        learned,
        header["resolution_m"],
        state.heights_m,
        header["robust"],
        [Tile(*place) for place in header["tiles"]],
    )
