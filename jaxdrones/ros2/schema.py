"""What a message type of ROS 2 is: fields with types, and how they go to and from the classes of other libraries."""

import dataclasses
import typing
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar


class Message:
    """A message of ROS 2; `NAME` is its type, such as `geometry_msgs/msg/Pose`."""

    NAME: ClassVar[str]


AnyMessage = TypeVar("AnyMessage", bound=Message)

MESSAGES: dict[str, type[Message]] = {}
"""All message types by their names in ROS."""
_FIELDS: dict[str, tuple["Field", ...]] = {}


@typing.dataclass_transform(frozen_default=True)
def message_of(package: str) -> Callable[[type[AnyMessage]], type[AnyMessage]]:
    """A decorator: the class is a message type of this package."""

    def register(cls: type[AnyMessage]) -> type[AnyMessage]:
        cls.NAME = f"{package}/msg/{cls.__name__}"
        made: Any = dataclasses.dataclass(frozen=True)(cls)
        MESSAGES[cls.NAME] = made
        hints = typing.get_type_hints(cls, include_extras=True)
        _FIELDS[cls.NAME] = tuple(_field(field.name, hints[field.name]) for field in dataclasses.fields(made))
        return cls

    return register


@dataclasses.dataclass(frozen=True)
class Field:
    """One field of a message."""

    name: str
    kind: str | type[Message]
    """`float64` and so on, or a message type."""
    length: int | None = None
    """Entries of an array; 0 of one whose length is free; `None` where the field is a single value."""


def fields(message: type[Message]) -> tuple[Field, ...]:
    """The fields of a message type, in their order on the wire."""
    return _FIELDS[message.NAME]


def _field(name: str, hint: Any) -> Field:
    if isinstance(hint, type):
        return Field(name, hint)
    kind = hint.__metadata__[0]
    if isinstance(kind, type):
        return Field(name, kind, 0)
    base, bracket, length = kind.partition("[")
    return Field(name, base, int(length.removesuffix("]") or 0) if bracket else None)


Arrays = Callable[[Field, Any], Any]
"""(field, tuple or bytes) -> an array as another library wants it."""


def encode(message: Message, class_of: Callable[[type[Message]], Any], array: Arrays) -> Any:
    """A message as an instance of another library's class.

    Args:
        message: to be translated, with everything in it.
        class_of: the other library's class for a message type; it is called with the fields as keywords.
        array: how the other library wants an array of numbers.
    """
    given = {
        field.name: _encoded(field, getattr(message, field.name), class_of, array) for field in fields(type(message))
    }
    return class_of(type(message))(**given)


def _encoded(field: Field, given: Any, class_of: Callable[[type[Message]], Any], array: Arrays) -> Any:
    if isinstance(field.kind, str):
        return given if field.length is None else array(field, given)
    if field.length is None:
        return encode(given, class_of, array)
    return [encode(entry, class_of, array) for entry in given]


def decode(kind: type[AnyMessage], foreign: Any) -> AnyMessage:
    """A message of another library as ours.

    Args:
        kind: type of the message.
        foreign: an object with its fields.
    """
    return kind(**{field.name: _decoded(field, getattr(foreign, field.name)) for field in fields(kind)})


def _decoded(field: Field, given: Any) -> Any:
    if not isinstance(field.kind, str):
        of = field.kind
        return decode(of, given) if field.length is None else tuple(decode(of, entry) for entry in given)
    if field.length is None:
        return given
    return bytes(given) if field.kind == "uint8" else tuple(map(float, given))
