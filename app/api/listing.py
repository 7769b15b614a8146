"""Lists by opaque cursor: `{"items": [...], "links": {"next"?: ...}}`, oldest first unless asked otherwise."""

from base64 import urlsafe_b64decode, urlsafe_b64encode
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Generic, Literal, TypeVar

from fastapi import Depends, Query, Request
from pydantic import BaseModel, Field
from sqlalchemy import Select
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.errors import Fault, InvalidInput

__all__ = ["Page", "Paging", "PagingDep", "list_page"]

Item = TypeVar("Item", bound=BaseModel)
Row = TypeVar("Row")


class Page(BaseModel, Generic[Item]):
    """One page of a list; `links` has `next` unless it is the last one."""

    items: list[Item]
    links: dict[str, str] = Field(examples=[{"next": "/v1/buildings?cursor=MDE5..."}])


class Paging:
    """The cursor, limit and order of a list request."""

    def __init__(
        self,
        request: Request,
        cursor: Annotated[str | None, Query(max_length=200, description="from `links.next`")] = None,
        limit: Annotated[int, Query(ge=1, le=200, description="most items on one page")] = 50,
        order: Annotated[Literal["oldest", "newest"], Query(description="which comes first")] = "oldest",
    ) -> None:
        self.url, self.limit, self.newest_first = request.url, limit, order == "newest"
        self.after = None if cursor is None else _decode(cursor)


PagingDep = Annotated[Paging, Depends()]


def list_page(
    session: Session,
    statement: Select[Row],
    id_column: InstrumentedAttribute[str],
    paging: Paging,
    show: Callable[[Row], Item],
) -> Page[Item]:
    """One page of the statement's rows in order of id, which is the order of creation, or backwards."""
    backwards = paging.newest_first
    if paging.after is not None:
        statement = statement.where(id_column < paging.after if backwards else id_column > paging.after)
    order = id_column.desc() if backwards else id_column
    rows: Sequence[Any] = session.scalars(statement.order_by(order).limit(paging.limit + 1)).all()
    links = {}
    if len(rows) > paging.limit:
        last = rows[paging.limit - 1].id
        url = paging.url.include_query_params(cursor=urlsafe_b64encode(last.encode()).decode())
        links["next"] = f"{url.path}?{url.query}"
    return Page[Any](items=[show(row) for row in rows[: paging.limit]], links=links)


def _decode(cursor: str) -> str:
    try:
        after = urlsafe_b64decode(cursor.encode("ascii")).decode("ascii")
    except ValueError:
        after = ""
    if not after.replace("-", "").isalnum():
        raise InvalidInput("this cursor was not made here", Fault("/query/cursor", "use `links.next` as it is"))
    return after
