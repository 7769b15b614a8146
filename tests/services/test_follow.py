"""Following with storage: the same steps give the same track, bit for bit, after restarts and by several processes."""

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from sqlalchemy import Engine, select
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import FolderBlobStore
from app.db.tables import Key, Map, Track, TrackState, TrackSteps
from app.errors import Conflict, InvalidInput, NotFound
from app.positioning.locate import prepare_floor
from app.services import follow as follow_module
from app.services.follow import Follower, Outcome
from app.services.grid_cache import GridCache
from app.services.locate_window import ActiveMap
from app.services.manage_keys import ensure_admin_key
from app.services.reach import Reach
from app.services.replay_track import replay_track
from app.services.track_log import batches_of, delete_track
from app.services.track_spec import StepKind, Trackers, check_walkable, core_frame, make_spec
from app.services.track_steps import core_step
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.track import begin, follow, make_tracker

Steps = list[dict[str, Any]]
OPTIONS = TrackOptions(particles=1000)


class World:
    """A hall with a map in a database, and followers of it: each is what a process has."""

    def __init__(self, engine: Engine, sessions: sessionmaker[Session], blobs: FolderBlobStore, ids: tuple[str, str]):
        self.engine, self.sessions, self.blobs = engine, sessions, blobs
        self.building_id, self.floor_id = ids
        self.pool = ThreadPoolExecutor(2)
        self.later = timedelta(0)
        self.opened: list[Follower] = []

    def follower(self, capacity_bytes: int = 2**26) -> Follower:
        made = Follower(
            self.engine, self.sessions, Trackers(GridCache(self.blobs, 2**26)), self.pool, idle_timeout_s=600.0,
            capacity_bytes=capacity_bytes, clock=lambda: datetime.now(UTC) + self.later,
        )  # fmt: skip
        self.opened.append(made)
        return made

    def new_track(self, frame: str = "level", seed: int = 7, **more: Any) -> Track:
        with self.sessions.begin() as session:
            key = session.scalars(select(Key)).first()
            assert key is not None
            row = Track(
                organisation_id=key.organisation_id, key_id=key.id, building_id=self.building_id, frame=frame,
                seed=seed, spec=self.spec(**more),
            )  # fmt: skip
            session.add(row)
        return row

    def spec(self, prior: StartPrior | None = None, ground: dict[str, Any] | None = None) -> dict[str, Any]:
        with self.sessions() as session:
            made = session.scalars(select(Map).where(Map.floor_id == self.floor_id)).one()
        assert made.grid_sha256 is not None
        return make_spec(
            [ActiveMap(self.floor_id, made.id, made.grid_sha256)], OPTIONS, prior, ground or {}, "building", None, None
        )


@pytest.fixture(scope="module")
def world(
    engine: Engine, sessions: sessionmaker[Session], tmp_path_factory: pytest.TempPathFactory, put_hall: Any
) -> Iterator[World]:
    blobs = FolderBlobStore(tmp_path_factory.mktemp("blobs"))
    with sessions.begin() as session:
        ensure_admin_key(session, "isd_follow")
    with sessions.begin() as session:
        ids = put_hall(session, blobs)
    world = World(engine, sessions, blobs, ids)
    yield world
    for each in world.opened:
        each.close()
    world.pool.shutdown()


def send(follower: Follower, track: Track, steps: Steps, size: int = 10, flush: bool = False) -> list[Outcome]:
    async def run() -> list[Outcome]:
        return [
            await follower.follow(track.id, Reach(track.organisation_id), steps[k : k + size], flush)
            for k in range(0, len(steps), size)
        ]

    return asyncio.run(run())


def said(world: World, track: Track) -> list[Any]:
    """All that was said along a track."""
    return [(batch.path, batch.settled, batch.estimate) for batch, _ in batches_of(world.sessions, track.id)]


@pytest.mark.parametrize("frame", ["level", "body", "building", "norm"])
def test_a_track_is_that_of_the_pure_tracker_and_replays_bit_for_bit(
    world: World, hall_grid: Any, hall_steps: Callable[..., Steps], hall_place_m: Any, frame: str
) -> None:
    steps, track = hall_steps(frame, 160), world.new_track(frame)
    outcomes = send(world.follower(), track, steps)
    tracker = make_tracker([prepare_floor(world.floor_id, hall_grid)], core_frame({}, frame), OPTIONS, 7)
    state = begin()
    for raw in steps:
        followed = follow(tracker, state, core_step(raw, StepKind(frame)))
        state = followed.state
    last = outcomes[-1].estimate
    assert followed.estimate is not None
    assert last["position_m"] == list(followed.estimate.position_m)
    assert last["covariance_m2"] == followed.estimate.covariance_m2.tolist()
    assert last["state"] == "converged"
    assert np.linalg.norm(np.array(last["position_m"][:2]) - hall_place_m(159)) < max(0.5, 2 * last["radius_95_m"])
    with world.sessions() as session:
        row = session.get_one(Track, track.id)
    assert (row.next_step, row.batches) == (160, 16)
    replayed = list(replay_track(world.sessions, world.follower().trackers, row))
    assert all(each.equal for each in replayed)
    assert [each.estimate for each in replayed] == [each.estimate for each in outcomes]


def test_another_seed_gives_another_track_and_a_replay_says_so(world: World, hall_steps: Callable[..., Steps]) -> None:
    track = world.new_track()
    send(world.follower(), track, hall_steps(count=120))
    with world.sessions() as session:
        row = session.get_one(Track, track.id)
    row.seed += 1
    replayed = list(replay_track(world.sessions, world.follower().trackers, row))
    assert replayed[0].equal, "nothing was drawn yet"
    assert not replayed[-1].equal


def test_a_restart_goes_on_as_if_there_was_none(
    world: World, hall_steps: Callable[..., Steps], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after every few batches, with a kept state behind it or without one."""
    monkeypatch.setattr(follow_module, "STATE_EVERY", 70)
    steps = hall_steps(count=300)
    undisturbed, disturbed = world.new_track(), world.new_track()
    send(world.follower(), undisturbed, steps)
    for k in range(0, 300, 50):
        send(world.follower(), disturbed, steps[k : k + 50])
    assert said(world, disturbed) == said(world, undisturbed)
    with world.sessions() as session:
        kept = session.get_one(TrackState, disturbed.id)
        assert kept.batches * 10 >= 200
        row = session.get_one(Track, disturbed.id)
    assert all(each.equal for each in replay_track(world.sessions, world.follower().trackers, row))
    with world.sessions.begin() as session:
        session.get_one(TrackState, disturbed.id).data = b"damaged"
    more = hall_steps(count=320)[300:]
    assert (
        send(world.follower(), disturbed, more)[-1].estimate == send(world.follower(), undisturbed, more)[-1].estimate
    )


@pytest.mark.parametrize(
    "database_url", ["sqlite", pytest.param("postgres", marks=[pytest.mark.postgres, pytest.mark.slow])], indirect=True
)
def test_two_processes_on_one_track_notice_each_other(world: World, hall_steps: Callable[..., Steps]) -> None:
    steps = hall_steps(count=200)
    alone, shared = world.new_track(), world.new_track()
    send(world.follower(), alone, steps)
    here, there = world.follower(), world.follower()
    for k in range(0, 200, 20):
        assert send(here, shared, steps[k : k + 10])[-1].next_step == k + 10
        assert send(there, shared, steps[k + 10 : k + 20])[-1].next_step == k + 20
    again = send(here, shared, steps[150:200], size=50)[-1]
    assert (again.accepted, again.duplicates) in ((0, 50), (10, 40))
    assert said(world, shared) == said(world, alone)


def test_clients_at_once_are_served_in_turn_and_nothing_is_followed_twice(
    world: World, hall_steps: Callable[..., Steps]
) -> None:
    steps, track, follower = hall_steps(count=60), world.new_track(), world.follower()

    async def run() -> list[Outcome]:
        asked = [follower.follow(track.id, Reach(track.organisation_id), steps[k : k + 10]) for k in range(0, 60, 10)]
        return await asyncio.gather(*asked, *[follower.follow(track.id, Reach(track.organisation_id), steps[:30])])

    outcomes = asyncio.run(run())
    assert sum(each.accepted for each in outcomes) == 60
    with world.sessions() as session:
        rows = session.scalars(select(TrackSteps).where(TrackSteps.track_id == track.id)).all()
    numbers = [step["number"] for batch, _ in batches_of(world.sessions, track.id) for step in batch.steps]
    assert numbers == list(range(60))
    assert len(rows) <= 6


def test_steps_that_wait_survive_a_restart(world: World, hall_steps: Callable[..., Steps]) -> None:
    steps, track = hall_steps(count=30), world.new_track()
    send(world.follower(), track, steps[:10])
    waits = send(world.follower(), track, steps[12:16])[-1]
    assert (waits.next_step, waits.waiting, waits.accepted) == (10, 4, 4)
    came = send(world.follower(), track, steps[10:12])[-1]
    assert (came.next_step, came.waiting) == (16, 0)
    straight = world.new_track()
    send(world.follower(), straight, steps[:10])
    send(world.follower(), straight, steps[10:16])
    assert said(world, track) == said(world, straight)


def test_little_memory_changes_nothing(world: World, hall_steps: Callable[..., Steps]) -> None:
    steps, follower = hall_steps(count=100), world.follower(capacity_bytes=1)
    tracks = [world.new_track(seed=seed) for seed in (1, 2)]
    for k in range(0, 100, 20):
        for track in tracks:
            send(follower, track, steps[k : k + 20], size=20)
    assert len(follower._live) == 1
    alone = world.new_track(seed=2)
    send(world.follower(), alone, steps, size=20)
    assert said(world, tracks[1]) == said(world, alone)


def test_an_idle_track_ends_and_is_followed_no_further(world: World, hall_steps: Callable[..., Steps]) -> None:
    steps, track, follower = hall_steps(count=20), world.new_track(), world.follower()
    send(follower, track, steps[:10])
    other = world.follower()
    send(other, track, steps[:10])
    world.later = timedelta(seconds=601)
    try:
        for each in (follower, world.follower()):
            with pytest.raises(Conflict, match="no step came for 600 s"):
                send(each, track, steps[10:])
        assert follower.end_idle() >= 1
        assert follower.end_idle() == 0
    finally:
        world.later = timedelta(0)
    with pytest.raises(Conflict, match="ended"):
        send(other, track, steps[10:])
    with world.sessions() as session:
        row = session.get_one(Track, track.id)
    assert (row.status, row.ended_reason, row.next_step) == ("ended", "idle", 10)


def test_a_track_that_was_removed_meanwhile_is_not_found(world: World, hall_steps: Callable[..., Steps]) -> None:
    steps, track, follower = hall_steps(count=20), world.new_track(), world.follower()
    send(follower, track, steps[:10])
    with world.sessions.begin() as session:
        delete_track(session, track.id)
    with pytest.raises(NotFound):
        send(follower, track, steps[10:])
    with world.sessions() as session:
        assert session.scalars(select(TrackSteps).where(TrackSteps.track_id == track.id)).all() == []


def test_a_fault_leaves_everything_as_it_was(world: World, hall_steps: Callable[..., Steps]) -> None:
    steps, track, follower = hall_steps(count=30), world.new_track(), world.follower()
    send(follower, track, steps[:10])
    before = said(world, track)
    with pytest.raises(InvalidInput, match="earlier than step"):
        send(follower, track, [*steps[10:15], {**steps[15], "t_s": 0.5}], size=6)
    assert said(world, track) == before
    assert send(follower, track, steps[10:20])[-1].next_step == 20


def test_a_prior_a_wall_and_a_walkable_area_are_pinned(world: World, hall_steps: Callable[..., Steps]) -> None:
    ring = [[0.0, 0.0], [12.0, 0.0], [12.0, 8.0], [0.0, 8.0], [0.0, 0.0]]
    ground = {
        "walkable": {world.floor_id: [[ring]]},
        "walls": {world.floor_id: [[[5.0, 7.5], [6.0, 7.5]]]},
        "connectors": [{"kind": "stairs", "floor_ids": [world.floor_id], "polygons": [[ring]]}],
    }
    track = world.new_track(prior=StartPrior((1.0, 1.0, 1.2), 1.0), ground=ground)
    tracker = world.follower().trackers.make(track.spec, "level", 7)
    check_walkable(tracker)
    assert len(tracker.barriers.segments) == 5
    assert tracker.options.ground is not None
    assert tracker.options.ground.connectors[0].inside(np.array([[1.0, 1.0], [13.0, 1.0]])).tolist() == [True, False]
    told = send(world.follower(), track, hall_steps(count=60))[-1].estimate
    assert told["floor_id"] == world.floor_id
    away = {"walkable": {world.floor_id: [[[[x + 50.0, y] for x, y in ring]]]}}
    with pytest.raises(InvalidInput, match="walkable"):
        check_walkable(world.follower().trackers.make(world.spec(ground=away), "level", 7))


def test_trackers_on_the_same_maps_share_them(world: World) -> None:
    trackers = world.follower().trackers
    one, two = (trackers.make(world.spec(), "level", seed) for seed in (1, 2))
    assert one.places is two.places
    assert (one.seed, two.seed) == (1, 2)
    assert trackers.make(world.spec(), "norm", 1).places is not one.places
