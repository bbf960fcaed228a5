import dataclasses
import inspect
from typing import Annotated

import jax
import jax.numpy as jnp
import pytest

from jaxdrones.arguments import Count, Fraction, Seconds, Switch, checked, choice, choices, function, number, whole
from jaxdrones.checks import UnexpectedKeyword


@checked
def flight(
    height: Annotated[float, number("m", at_least=0, at_most=5)],
    drones: Annotated[int, whole("number of drones", minimum=2, limit=9)] = 2,
    *,
    duration: Seconds | None = None,
    curve: Annotated[str | None, choice("curve", ("circle", "hop"))] = None,
    images: Annotated[tuple[str, ...], choices("image", ("depth", "rgb"), "'depth'")] = (),
    control: Annotated[object, function("jaxdrones.control.pid")] = abs,
    ground: Switch = True,
    **others: Annotated[float, number("m/s", "{argument} of the flight")],
) -> float:
    """Height doubled."""
    return 2 * height


@checked
@dataclasses.dataclass(frozen=True)
class Settings:
    worlds: Count = 256
    fraction: Fraction = 0.5


@dataclasses.dataclass(frozen=True)
class Base:
    worlds: Count = 1


@checked
@dataclasses.dataclass(frozen=True)
class Derived(Base):
    name: str = ""


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"height": 6.0}, r"height is 6.0; give a number of at least 0 and at most 5 \(m\)"),
        ({"drones": 1}, "number of drones is 1; give a whole number of at least 2"),
        ({"drones": 10}, "number of drones is 10; give at most 9"),
        ({"duration": 0.0}, r"duration is 0.0; give a positive number \(s\)"),
        ({"curve": "hopp"}, "unknown curve 'hopp'; did you mean 'hop'"),
        ({"images": "depth"}, r"images is 'depth'; give a sequence, for example \('depth',\)"),
        ({"images": ["dept"]}, "unknown image 'dept'; did you mean 'depth'"),
        ({"control": 3}, "control: 3 is not a function; give for example jaxdrones.control.pid"),
        ({"ground": "no"}, "ground is 'no'; give True or False"),
    ],
)
def test_a_wrong_argument_is_named_with_what_to_give(given, message):
    with pytest.raises(ValueError, match=message):
        flight(**{"height": 1.0} | given)


def test_an_iterator_is_no_sequence():
    """It could be read only once, by the check or by the function."""
    with pytest.raises(ValueError, match=r"images is <.*; give a sequence, for example \('depth',\)"):
        flight(1.0, images=iter(["depth"]))


def test_arguments_are_checked_by_position_as_by_name():
    with pytest.raises(ValueError, match="height is -1"):
        flight(-1)
    with pytest.raises(ValueError, match="number of drones is 0"):
        flight(1.0, 0)


def test_none_passes_where_it_is_allowed():
    assert flight(1.0, duration=None, curve=None) == 2.0
    with pytest.raises(ValueError, match="height is None"):
        flight(None)


def test_traced_numbers_pass():
    assert jax.jit(flight)(jnp.asarray(9.0)) == 18.0
    assert jax.vmap(lambda x: jnp.asarray(Settings(fraction=x).fraction))(jnp.arange(3.0)).tolist() == [0, 1, 2]


def test_a_dataclass_is_checked_when_it_is_made_and_replaced():
    with pytest.raises(ValueError, match="fraction is 2"):
        Settings(3, 2)
    with pytest.raises(ValueError, match="worlds is 0"):
        dataclasses.replace(Settings(), worlds=0)


def test_inherited_fields_are_checked():
    with pytest.raises(ValueError, match="worlds is 0"):
        Derived(0)


def test_an_unknown_keyword_names_the_closest_one():
    with pytest.raises(UnexpectedKeyword, match=r"Settings\(\) got an unexpected .* 'world'; did you mean 'worlds'\?"):
        Settings(world=3)
    assert flight(1.0, wind=2.0) == 2.0  # other keywords are welcome
    with pytest.raises(ValueError, match=r"wind of the flight is nan; give a finite number \(m/s\)"):
        flight(1.0, wind=float("nan"))


def test_signature_and_documentation_remain():
    assert flight.__doc__ == "Height doubled."
    assert [*inspect.signature(flight).parameters][:3] == ["height", "drones", "duration"]
    assert "Annotated[int" in str(inspect.signature(Settings).parameters["worlds"])


@checked
def short_flight(size: Annotated[float, number("m", "{argument} of {function}", above=0)] = 1.0) -> None:
    pass


def test_a_message_may_name_the_function():
    with pytest.raises(ValueError, match=r"size of short-flight is 0; give a positive number \(m\)"):
        short_flight(0)
