"""Keep maps ready: what was searched lately is searched again, by then perhaps on a floor's next map.

A worker publishes a map without telling the web processes. Each looks, every few seconds and by one statement, where
the floors that it searched point to now, and prepares what is new before somebody asks.
"""

from sqlalchemy import Engine, select

from app.db.tables import Floor, Map
from app.services.grid_cache import GridCache

__all__ = ["keep_warm"]


def keep_warm(engine: Engine, grids: GridCache) -> int:
    """Prepare the maps that the floors in use point to now; how many sets of floors had a new one.

    Raises NotFound, CorruptArtefact for a map that cannot be read.
    """
    floor_ids = grids.searched_floors()
    if not floor_ids:
        return 0
    active = select(Floor.id, Map.grid_sha256).join(Map, Map.id == Floor.active_map_id).where(Floor.id.in_(floor_ids))
    with engine.connect() as connection:
        now = {floor_id: sha256 for floor_id, sha256 in connection.execute(active) if sha256 is not None}
    return grids.renew(now)
