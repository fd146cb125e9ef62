"""Settings are nested frozen dataclasses. This module reads and writes them as TOML and applies `key=value` changes.

The type of a field is bool, int, float, str, a Literal of str, a tuple of these, or a dataclass; any of them may be
optional. A field may have a default, but no default factory. TOML has no word for None, so None is written as the
string "none". A field that holds one of several dataclasses has the metadata `class_of`: a function that takes the
field's TOML table and returns the class. A field with the metadata FROM_DATA holds a dataclass of facts of the data.
These are no settings: nothing here reads, writes or changes them.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass
from numbers import Integral, Real
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from ast_sim.support.errors import ConfigError

NONE = "none"
FROM_DATA = "from_data"
LARGEST = 2**63 - 1  # TOML's integers have 64 bits
NOTHING: Mapping[str, Any] = MappingProxyType({})

T = TypeVar("T")


@dataclass(frozen=True)
class SettingHelp:
    """One setting as a user sees it: its dotted name, its type, its default (None: a value must be given), its help."""

    key: str
    type: str
    default: str | None
    help: str


def known(value: T | None) -> T:
    """A value that is None only until settings are resolved, or in a scene that they do not fit."""
    assert value is not None, "the settings are not resolved, or do not fit the scene"
    return value


def settings(cls: type, given: Mapping[str, Any] = NOTHING) -> Iterator[SettingHelp]:
    """All settings of a dataclass and of its nested dataclasses, in order. A field's metadata `help` is its help.

    A value in `given`, by dotted key, takes the place of the default.
    """
    for key, item, kind in _leaves(cls):
        default = given.get(key, item.default)
        shown = None if default is MISSING else _show(default)
        yield SettingHelp(key, _describe(kind), shown, item.metadata.get("help", ""))


def to_toml(obj: Any) -> str:
    """The settings as TOML: every key is present, in the order of the fields."""
    import tomli_w

    return tomli_w.dumps(to_values(obj))


def to_values(value: Any) -> Any:
    """Settings as a TOML table: nested dictionaries, lists, texts and numbers."""
    if dataclasses.is_dataclass(value):
        chosen = [item.name for item in dataclasses.fields(value) if FROM_DATA not in item.metadata]
        return {name: to_values(getattr(value, name)) for name in chosen}
    if isinstance(value, tuple):
        return [to_values(member) for member in value]
    if isinstance(value, Real) and not isinstance(value, int | float):  # a scalar of NumPy
        return int(value) if isinstance(value, Integral) else float(value)
    return NONE if value is None else value


def from_values(cls: type[T], values: Mapping[str, Any]) -> T:
    """Settings from a parsed TOML table; a missing key takes its default.

    Raises:
        ConfigError: a key is unknown (the text names the nearest known key), a key without a default is missing, or a
            value has the wrong type.
    """
    return _with(cls, values, dict(leaves(values)))


def whole(least: int | None = None, /, **numbers: Any) -> list[Any]:
    """The numbers as plain integers, whatever integer types they have; None stays None.

    Raises:
        ConfigError: one is no whole number, or below `least`; the text names it.
    """
    for name, value in numbers.items():
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, Integral):
            raise ConfigError(f"{name} is {value!r}; it must be a whole number")
        numbers[name] = int(value)
        if least is not None:
            require_range(name, numbers[name], least)
    return list(numbers.values())


def required_whole(least: int | None = None, /, **numbers: Any) -> list[int]:
    """As `whole`, for numbers that cannot be None."""
    for name, value in numbers.items():
        if value is None:
            raise ConfigError(f"{name} is None; it must be a whole number")
    return whole(least, **numbers)


def require_range(key: str, value: float | None, least: float, most: float = LARGEST) -> None:
    """Raise ConfigError if the value is set, and is no number, below `least` or above `most`."""
    if value is not None and (isinstance(value, bool) or not isinstance(value, Real)):
        raise ConfigError(f"{key} is {value!r}; it must be a number")
    if value is not None and not least <= value <= most:
        limit = f"least {least}" if value < least else f"most {most}"
        raise ConfigError(f"{key} is {value}; it must be at {limit}")


def assigned(obj: Any, assignments: Iterable[str]) -> dict[str, Any]:
    """New values of settings by dotted key. Each assignment has the form `a.b=c`; the last one to a key counts.

    Values are TOML; the quotes of a string and the brackets of a list may be left out (`model.inputs=stress,material`).

    Raises:
        ConfigError: an assignment has no `=`, or its list has an empty place.
    """
    values = {}
    kinds = {key: kind for key, _, kind in _leaves(type(obj), obj)}
    for assignment in assignments:
        key, equals, text = (part.strip() for part in assignment.partition("="))
        if not equals:
            raise ConfigError(f"{assignment!r} is no setting: write key=value")
        values[key] = _parse(text, kinds[key]) if key in kinds else text
        if isinstance(values[key], list) and "" in values[key]:
            raise ConfigError(f"{assignment!r} has an empty place in its list: put one comma between two values")
    return values


def leaves(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of every value of a TOML table that is no table, or an empty one."""
    for key, value in table.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def change(obj: T, values: Mapping[str, Any]) -> T:
    """A copy with some settings replaced; `values` gives the new values by dotted key.

    Raises:
        ConfigError: a key is unknown (the text names the nearest known key), or a fact of the data, or a value has the
            wrong type.
    """
    return _with(type(obj), obj, values)


def _with(cls: type[T], given: Any, values: Mapping[str, Any]) -> T:
    """Settings of a class with values by dotted key, the others from `given`; `_leaves` says what that is."""
    kinds = {key: kind for key, _, kind in _leaves(cls, given)}
    groups = {key.rpartition(".")[0] for key in kinds}
    values = {key: value for key, value in values.items() if key not in groups or value}  # a group may say nothing
    for key in values:
        if key not in kinds:
            raise _unknown(kinds, key, _facts(cls, given))
    return _build(cls, given, {key: _convert(to_values(value), kinds[key], key) for key, value in values.items()})


def _build(cls: Any, given: Any, values: Mapping[str, Any], prefix: str = "") -> Any:
    arguments = {}
    kinds = get_type_hints(cls)
    for item in dataclasses.fields(cls):
        key = prefix + item.name
        kind = kinds[item.name]
        if FROM_DATA in item.metadata:
            arguments[item.name] = getattr(given, item.name, item.default)
        elif dataclasses.is_dataclass(kind):
            arguments[item.name] = _build(*_group(item, kind, given, key), values, f"{key}.")
        elif key in values:
            arguments[item.name] = values[key]
        elif dataclasses.is_dataclass(given):
            arguments[item.name] = getattr(given, item.name)
        elif item.default is MISSING:
            raise ConfigError(f"the setting {key} is missing; must be {_describe(kind)}")
    return cls(**arguments)


def _leaves(cls: type, given: Any = NOTHING, prefix: str = "") -> Iterator[tuple[str, dataclasses.Field, Any]]:
    """(dotted key, field, type) of every setting that is no group. `given` is an object of the class or a table of
    its values; it decides the classes of the groups."""
    kinds = get_type_hints(cls)
    for item in dataclasses.fields(cls):
        key = prefix + item.name
        kind = kinds[item.name]
        if FROM_DATA in item.metadata:
            continue
        if dataclasses.is_dataclass(kind):
            yield from _leaves(*_group(item, kind, given, key), f"{key}.")
        else:
            yield key, item, kind


def _facts(cls: type, given: Any, prefix: str = "") -> Iterator[str]:
    """The dotted keys that facts of the data would have if they were settings; arguments as of `_leaves`."""
    kinds = get_type_hints(cls)
    for item in dataclasses.fields(cls):
        key = prefix + item.name
        kind = kinds[item.name]
        if FROM_DATA in item.metadata:
            names = [fact.name for fact in dataclasses.fields(kind)]
            yield from (key, *(prefix + name for name in names), *(f"{key}.{name}" for name in names))
        elif dataclasses.is_dataclass(kind):
            yield from _facts(*_group(item, kind, given, key), f"{key}.")


def _group(item: dataclasses.Field, kind: Any, given: Any, key: str) -> tuple[type, Any]:
    """The class of a group, and what `given` holds for it: an object or a table."""
    if dataclasses.is_dataclass(given):
        group = getattr(given, item.name)
        return type(group), group
    table = given.get(item.name, NOTHING)
    if not isinstance(table, Mapping):
        raise ConfigError(f"{key} is {table!r}; must be a group of settings ([{key}])")
    class_of = item.metadata.get("class_of")
    return (class_of(table) if class_of else kind), table


def _unknown(known: Iterable[str], key: str, facts: Iterable[str]) -> ConfigError:
    if key in facts:
        return ConfigError(f"{key} is no setting but a fact of the data, which the dataset has: leave it out")
    members = [name for name in known if name.startswith(f"{key}.")]
    if members:
        return ConfigError(f"{key} is a group of settings, such as {members[0]}")

    def likeness(name: str) -> float:
        last, wanted = name.rpartition(".")[2], key.rpartition(".")[2]
        whole = difflib.SequenceMatcher(None, key, name).ratio()
        return max(whole, 0.99 * difflib.SequenceMatcher(None, wanted, last).ratio() + 0.01 * whole)

    return ConfigError(f"there is no setting {key}; the nearest is {max(known, key=likeness)}")


def _parse(text: str, kind: Any) -> Any:
    """The text after `=` as a TOML value. Text that is not TOML becomes a string, or a list where the type asks for
    one."""
    if str in _members(kind) and text[:1] not in ('"', "'"):
        return text
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = {"true": True, "false": False}.get(text.lower(), text)
    items = [get_args(member)[0] for member in _members(kind) if get_origin(member) is tuple]
    if items and not isinstance(value, list) and text != NONE:
        return [_parse(part.strip(), items[0]) for part in text.split(",")] if text else []
    return value


def _members(kind: Any) -> tuple[Any, ...]:
    """The members of a union; of any other type the type itself."""
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def _convert(value: Any, kind: Any, key: str) -> Any:
    """Convert a TOML value to the type.

    Raises:
        ConfigError: the value does not fit; the text names the key, the value and the type.
    """
    members = _members(kind)
    if NoneType in members and value == NONE:
        return None
    for member in members:
        if get_origin(member) is Literal and isinstance(value, str) and value in get_args(member):
            return value
        if get_origin(member) is tuple and isinstance(value, list):
            items = get_args(member)
            items = items[:1] * len(value) if items[-1] is Ellipsis else items
            if len(items) == len(value):
                return tuple(_convert(v, t, f"{key}[{i}]") for i, (v, t) in enumerate(zip(value, items, strict=True)))
        if type(value) is int and not -LARGEST - 1 <= value <= LARGEST:
            where = f"above {LARGEST}, the largest" if value > 0 else f"below {-LARGEST - 1}, the smallest"
            raise ConfigError(f"{key} is {where} whole number")
        if member in (bool, int, str) and type(value) is member:
            return value
        if member is float and isinstance(value, int | float) and type(value) is not bool and not math.isnan(value):
            return float(value)
    raise ConfigError(f"{key} is {value!r}; must be {_describe(kind)}")


def _describe(kind: Any) -> str:
    names = {bool: "true or false", int: "an integer", float: "a number", str: "a text", NoneType: f'"{NONE}"'}
    texts = []
    for member in _members(kind):
        if get_origin(member) is Literal:
            texts.append("one of " + ", ".join(f'"{value}"' for value in get_args(member)))
        elif get_origin(member) is tuple:
            items = get_args(member)
            count = "" if items[-1] is Ellipsis else f"{len(items)} values, "
            texts.append(f"a list ({count}each {_describe(items[0])})")
        else:
            texts.append(names[member])
    return " or ".join(texts)


def _show(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(_show, value))
    if isinstance(value, bool):
        return str(value).lower()
    return NONE if value is None else str(value)
