"""`isodyn doctor --deep`: every blob is read, and what is damaged, missing or named by nobody is told."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

from app.cli.finding import Finding
from app.cli.installation import open_installation, progress_bar
from app.errors import IsodynError
from app.services.check_blobs import BlobHealth, check_blobs
from app.settings import Settings

__all__ = ["ORPHAN_AGE", "examine_blobs"]

ORPHAN_AGE = timedelta(days=1)
_SHOWN = 10
_BRING_BACK = (
    "copy it from a backup (`blobs/SHA256` in the archive), or upload what it was made from again: an upload of the "
    "same bytes repairs it; a map is built again"
)


def examine_blobs(settings: Settings) -> list[Finding]:
    """Findings on every blob; a look that fails is a finding."""
    try:
        with open_installation(settings) as here, progress_bar() as progress:
            before = datetime.now(UTC) - ORPHAN_AGE
            health = check_blobs(here.sessions, here.queue, here.blobs, before, progress)
    except IsodynError as error:
        return [Finding("blobs", None, str(error))]
    return list(_findings(health))


def _findings(health: BlobHealth) -> Iterator[Finding]:
    checked = f"{health.checked:,} of {health.checked_bytes:,} bytes are whole"
    yield Finding("blobs", True, f"{checked}; {health.young:,} that nothing names yet are younger than a day")
    if health.damaged:
        names = [blob.sha256 for blob in health.damaged]
        yield Finding("damaged blobs", False, _listed(health, names), _BRING_BACK)
    if health.missing:
        yield Finding("missing blobs", False, _listed(health, health.missing), _BRING_BACK)
    if spare := [*(blob.sha256 for blob in health.damaged_caches), *health.missing_caches]:
        yield Finding("caches", None, _listed(health, spare), "nothing: the next build of the floor is a full one")
    if health.orphaned:
        size = sum(blob.size_bytes for blob in health.orphaned)
        seen = f"{len(health.orphaned):,} of {size:,} bytes that nothing names, older than a day"
        yield Finding("orphaned blobs", None, seen, "`isodyn clean` deletes them")


def _listed(health: BlobHealth, names: list[str]) -> str:
    """How many, and the first of them with what names them."""
    lines = [f"{name} ({', '.join(health.named.named_by(name)) or 'no row'})" for name in names[:_SHOWN]]
    more = [f"and {len(names) - _SHOWN:,} more"] if len(names) > _SHOWN else []
    return "\n".join([f"{len(names):,}:", *lines, *more])
