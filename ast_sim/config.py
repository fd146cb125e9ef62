"""Settings: nested frozen dataclasses, to and from TOML, with overrides from the command line.

A field may be bool, int, float, str, a Literal of str, a tuple of these, a dataclass, and each of them or None. TOML
has no word for None: it is written as the string "none". A field may also be one of several dataclasses: the first
field of each, a Literal, tells them apart.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from ast_sim.errors import ConfigError

NONE = "none"

T = TypeVar("T")


@dataclass(frozen=True)
class Setting:
    """One setting as it is shown to a user: its dotted name, type, default (None where it must be given) and help."""

    key: str
    type: str
    default: str | None
    help: str


def settings(cls: type) -> Iterator[Setting]:
    """All settings of a dataclass and of those nested in it, in order; the help is the metadata `help` of a field."""
    for key, item, kind in _leaves(cls):
        default = item.default if item.default_factory is MISSING else item.default_factory()
        shown = None if default is MISSING else _show(default)
        yield Setting(key, _describe(kind), shown, item.metadata.get("help", ""))


def to_toml(obj: Any) -> str:
    """The settings as TOML, every key present, tables in the order of the fields."""
    import tomli_w

    return tomli_w.dumps(_to_plain(obj))


def from_toml(cls: type[T], text: str) -> T:
    """Read settings; keys that are left out take their defaults.

    Raises:
        ConfigError: text that is not TOML, or values as `from_values` refuses them.
    """
    try:
        values = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"the settings are not valid TOML: {error}") from error
    return from_values(cls, values)


def from_values(cls: type[T], values: Mapping[str, Any]) -> T:
    """Settings of a TOML table that has been read.

    Raises:
        ConfigError: an unknown key (the nearest known one is named), a missing key without a default, a value of the
            wrong type.
    """
    return _build(cls, values, cls, "")


def override(obj: T, assignments: list[str]) -> T:
    """A copy with settings replaced, each given as `a.b=c`; the last one of a key holds.

    Values are TOML; the quotes of a string and the brackets of a list may be left out (`model.inputs=stress,material`).

    Raises:
        ConfigError: an assignment without `=`, an unknown key (the nearest known one is named), a wrong type.
    """
    changes: dict[str, Any] = {}
    kinds = {key: kind for key, _, kind in _leaves(type(obj), obj=obj)}
    for assignment in assignments:
        key, equals, text = (part.strip() for part in assignment.partition("="))
        if not equals:
            raise ConfigError(f"{assignment!r} is no setting: write key=value")
        if key not in kinds:
            raise _unknown(type(obj), key)
        node = changes
        *groups, last = key.split(".")
        for group in groups:
            node = node.setdefault(group, {})
        node[last] = _convert(_parse(text, kinds[key]), kinds[key], key)
    return _replace(obj, changes)


def _replace(obj: T, changes: Mapping[str, Any]) -> T:
    values = {
        name: _replace(getattr(obj, name), value) if isinstance(value, dict) else value
        for name, value in changes.items()
    }
    return dataclasses.replace(obj, **values)


def _build(cls: type[T], values: Mapping[str, Any], root: type, prefix: str) -> T:
    kinds = get_type_hints(cls)
    items = {item.name: item for item in dataclasses.fields(cls)}
    unknown = next((name for name in values if name not in items), None)
    if unknown is not None:
        raise _unknown(root, prefix + unknown)
    arguments = {}
    for name, item in items.items():
        key, kind = prefix + name, kinds[name]
        if _is_group(kind):
            table = values.get(name, {})
            if not isinstance(table, dict):
                raise ConfigError(f"{key} is {table!r}; must be a group of settings ([{key}])")
            arguments[name] = _build(_chosen(kind, table, key), table, root, f"{key}.")
        elif name in values:
            arguments[name] = _convert(values[name], kind, key)
        elif item.default is MISSING and item.default_factory is MISSING:
            raise ConfigError(f"the setting {key} is missing; must be {_describe(kind)}")
    return cls(**arguments)


def _leaves(cls: type, prefix: str = "", obj: Any = None) -> Iterator[tuple[str, dataclasses.Field, Any]]:
    """(dotted key, field, type) of every setting that is no group; where a group is of several kinds, of that in `obj`
    or of all."""
    kinds = get_type_hints(cls)
    for item in dataclasses.fields(cls):
        kind = kinds[item.name]
        if _is_group(kind):
            group = None if obj is None else getattr(obj, item.name)
            for member in _members(kind) if group is None else (type(group),):
                yield from _leaves(member, f"{prefix}{item.name}.", group)
        else:
            yield prefix + item.name, item, kind


def _is_group(kind: Any) -> bool:
    return all(dataclasses.is_dataclass(member) for member in _members(kind))


def _chosen(kind: Any, table: Mapping[str, Any], key: str) -> type:
    """Of the kinds of a group the one that the table names; the first if it names none."""
    members = _members(kind)
    if len(members) == 1:
        return members[0]
    tag = dataclasses.fields(members[0])[0].name
    named = {get_args(get_type_hints(member)[tag])[0]: member for member in members}
    name = table.get(tag, next(iter(named)))
    if name not in named:
        raise ConfigError(f"{key}.{tag} is {name!r}; must be one of {', '.join(named)}")
    return named[name]


def _unknown(cls: type, key: str) -> ConfigError:
    known = [name for name, _, _ in _leaves(cls)]
    members = [name for name in known if name.startswith(f"{key}.")]
    if members:
        return ConfigError(f"{key} is a group of settings, such as {members[0]}")

    def likeness(name: str) -> float:
        last, wanted = name.rpartition(".")[2], key.rpartition(".")[2]
        whole = difflib.SequenceMatcher(None, key, name).ratio()
        return max(whole, 0.99 * difflib.SequenceMatcher(None, wanted, last).ratio() + 0.01 * whole)

    return ConfigError(f"there is no setting {key}; the nearest is {max(known, key=likeness)}")


def _parse(text: str, kind: Any) -> Any:
    """The text after `=` as a TOML value; text that is none is a string, or a list if one is wanted."""
    if str in _members(kind) and text[:1] not in ('"', "'"):
        return text
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        value = {"true": True, "false": False}.get(text.lower(), text)
    listed = any(get_origin(member) is tuple for member in _members(kind))
    if listed and not isinstance(value, list) and text != NONE:
        item = next(get_args(member)[0] for member in _members(kind) if get_origin(member) is tuple)
        return [_parse(part.strip(), item) for part in text.split(",") if part.strip()]
    return value


def _members(kind: Any) -> tuple[Any, ...]:
    """The alternatives of a union, or the type alone."""
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def _convert(value: Any, kind: Any, key: str) -> Any:
    """A TOML value as a value of the type.

    Raises:
        ConfigError: naming the key, the value and the type.
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
        if member in (bool, int, str) and type(value) is member:
            return value
        if member is float and type(value) in (int, float) and not math.isnan(value):
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


def _to_plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {item.name: _to_plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_to_plain(member) for member in value]
    return NONE if value is None else value


def _show(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(_show, value))
    if isinstance(value, bool):
        return str(value).lower()
    return NONE if value is None else str(value)
