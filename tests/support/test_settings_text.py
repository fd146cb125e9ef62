"""Settings to and from TOML, overrides, and errors that name the key."""

import tomllib
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import (
    FROM_DATA,
    SettingHelp,
    assigned,
    change,
    from_values,
    require_range,
    settings,
    to_toml,
    whole,
)


@dataclass(frozen=True)
class Facts:
    young: float = 0.0


@dataclass(frozen=True)
class Model:
    hidden: int = field(default=128, metadata={"help": "channels"})
    inputs: tuple[str, ...] = ()
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stress: Literal["none", "node", "element"] = "none"
    noise: float | None = None
    residual: bool = True
    facts: Facts = field(default=Facts(), metadata={FROM_DATA: True})


@dataclass(frozen=True)
class Facts:
    young: float = 0.0


@dataclass(frozen=True)
class Run:
    model: Model
    data: str
    rate: float = 1e-4
    tag: str | None = None


RUN = Run(Model(), "data.h5")


def from_toml(cls, text):
    return from_values(cls, tomllib.loads(text))


def override(obj, assignments):
    return change(obj, assigned(obj, assignments))


def test_every_key_is_written_and_read_back():
    run = Run(Model(64, ("stress", "u"), (1.0, -2.5, 1e-30), "element", 0.003, False), 'C:\\a "b"\n.h5', float("inf"))
    text = to_toml(run)
    assert from_toml(Run, text) == run
    assert 'tag = "none"' in text and "[model]" in text and "hidden = 64" in text


@given(
    rate=st.floats(allow_nan=False),
    hidden=st.integers(-(2**63), 2**63 - 1),
    data=st.text(st.characters(exclude_categories=["Cs"])),
    inputs=st.lists(st.text(st.characters(exclude_categories=["Cs"]))),
)
def test_any_value_survives_the_round_trip(rate, hidden, data, inputs):
    run = Run(Model(hidden=hidden, inputs=tuple(inputs)), data, rate)
    assert from_toml(Run, to_toml(run)) == run


def test_missing_keys_take_their_defaults():
    assert from_toml(Run, 'data = "x"\n[model]\nhidden = 3') == Run(Model(hidden=3), "x")


@pytest.mark.parametrize(
    ("assignment", "path", "value"),
    [
        ("model.hidden=32", "model.hidden", 32),
        (" model.hidden = 32 ", "model.hidden", 32),
        ("model.inputs=stress,material", "model.inputs", ("stress", "material")),
        ('model.inputs=["stress"]', "model.inputs", ("stress",)),
        ("model.inputs=", "model.inputs", ()),
        ("model.center=1,2.5,-3", "model.center", (1.0, 2.5, -3.0)),
        ("model.stress=node", "model.stress", "node"),
        ("model.stress=none", "model.stress", "none"),
        ("model.noise=3e-3", "model.noise", 0.003),
        ("model.noise=none", "model.noise", None),
        ("model.residual=False", "model.residual", False),
        ("rate=1", "rate", 1.0),
        ("data=a=b 3.h5", "data", "a=b 3.h5"),
        ("data=12", "data", "12"),
        ('data=" 12"', "data", " 12"),
        ("tag=none", "tag", None),
    ],
)
def test_an_override_sets_one_value_and_nothing_else(assignment, path, value):
    changed = override(RUN, [assignment])
    holder = changed.model if path.startswith("model.") else changed
    name = path.rpartition(".")[2]
    assert getattr(holder, name) == value and type(getattr(holder, name)) is type(value)
    original = RUN.model if path.startswith("model.") else RUN
    back = override(changed, [f"{path}={_as_text(getattr(original, name))}"])
    assert back == RUN


def _as_text(value):
    if isinstance(value, tuple):
        return "[" + ",".join(map(str, value)) + "]"
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def test_the_last_override_of_a_key_holds():
    assert override(RUN, ["rate=1", "model.hidden=2", "rate=3"]) == Run(Model(hidden=2), "data.h5", 3.0)


def test_facts_of_the_data_are_kept_by_a_change_but_neither_written_read_nor_listed():
    stiff = Run(Model(facts=Facts(3.0)), "data.h5")
    assert override(stiff, ["model.hidden=2"]) == Run(Model(2, facts=Facts(3.0)), "data.h5")
    assert from_toml(Run, to_toml(stiff)) == RUN
    assert not [one.key for one in settings(Run) if "young" in one.key or "facts" in one.key]


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("model.hiden=3", "there is no setting model.hiden; the nearest is model.hidden"),
        ("hidden=3", "there is no setting hidden; the nearest is model.hidden"),
        ("modle.residual=true", "there is no setting modle.residual; the nearest is model.residual"),
        ("model=3", "model is a group of settings, such as model.hidden"),
        ("rate.x=3", "there is no setting rate.x; the nearest is rate"),
        *(
            (f"{key}=3", f"{key} is no setting but a fact of the data, which the dataset has: leave it out")
            for key in ("model.young", "model.facts", "model.facts.young")
        ),
        ("model.hidden", "'model.hidden' is no setting: write key=value"),
        ("model.hidden=1.5", "model.hidden is 1.5; must be an integer"),
        ("model.hidden=true", "model.hidden is True; must be an integer"),
        ("model.hidden=", "model.hidden is ''; must be an integer"),
        ("model.residual=1", "model.residual is 1; must be true or false"),
        ("model.noise=much", "model.noise is 'much'; must be a number or \"none\""),
        ("rate=none", "rate is 'none'; must be a number"),
        ("rate=nan", "rate is nan; must be a number"),
        ("model.stress=nodes", 'model.stress is \'nodes\'; must be one of "none", "node", "element"'),
        ("model.center=1,2", "model.center is [1, 2]; must be a list (3 values, each a number)"),
        ("model.center=1,2,x", "model.center[2] is 'x'; must be a number"),
        *(
            (
                f"model.center={text}",
                f"'model.center={text}' has an empty place in its list: put one comma between two values",
            )
            for text in (",", ",,", "1,,2", "1,2,", ",1,2", "1, ,2")
        ),
    ],
)
def test_a_wrong_override_names_the_key_and_what_would_fit(assignment, message):
    with pytest.raises(ConfigError) as error:
        override(RUN, [assignment])
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the setting data is missing; must be a text"),
        ('data = "x"\nmodel = 3', "model is 3; must be a group of settings ([model])"),
        ('data = "x"\n[model]\nhiden = 3', "there is no setting model.hiden; the nearest is model.hidden"),
        ('data = "x"\n[model]\nhidden = "3"', "model.hidden is '3'; must be an integer"),
        ('data = "x"\n[model]\ninputs = "stress"', "model.inputs is 'stress'; must be a list (each a text)"),
        ('data = "x"\n[model]\ninputs = ["u", 3]', "model.inputs[1] is 3; must be a text"),
    ],
)
def test_wrong_toml_names_the_key_and_what_would_fit(text, message):
    with pytest.raises(ConfigError) as error:
        from_toml(Run, text)
    assert message in str(error.value)


def test_settings_are_listed_with_their_help():
    listed = {setting.key: setting for setting in settings(Run)}
    assert list(listed)[:2] == ["model.hidden", "model.inputs"] and len(listed) == 9
    assert listed["model.hidden"] == SettingHelp("model.hidden", "an integer", "128", "channels")
    assert listed["data"].default is None
    assert listed["model.center"].default == "0.0,0.0,0.0"
    assert listed["tag"] == SettingHelp("tag", 'a text or "none"', "none", "")


@dataclass(frozen=True)
class Shape:
    shape: str = ""


@dataclass(frozen=True)
class Circle(Shape):
    shape: Literal["circle"] = "circle"
    radius: float = 1.0


@dataclass(frozen=True)
class Box(Shape):
    shape: Literal["box"] = "box"
    side: float = 2.0


def class_of(table):
    return {"circle": Circle, "box": Box}[table.get("shape", "circle")]


@dataclass(frozen=True)
class Drawing:
    figure: Shape = field(metadata={"class_of": class_of})
    title: str = ""


def test_the_class_of_a_group_follows_from_its_table():
    drawing = Drawing(Box(side=3.0), "b")
    assert from_toml(Drawing, to_toml(drawing)) == drawing
    assert from_toml(Drawing, "") == Drawing(Circle())
    assert override(drawing, ["figure.side=4"]) == Drawing(Box(side=4.0), "b")
    assert [s.key for s in settings(Drawing)] == ["figure.shape", "figure.radius", "title"]
    with pytest.raises(ConfigError, match=r"no setting figure.sied; the nearest is figure.side"):
        from_toml(Drawing, '[figure]\nshape = "box"\nsied = 3')
    with pytest.raises(ConfigError, match=r"no setting figure.radius; the nearest is figure.s"):
        override(drawing, ["figure.radius=4"])
    with pytest.raises(ConfigError, match="figure.shape is 'box'; must be one of \"circle\""):
        override(Drawing(Circle()), ["figure.shape=box"])


def test_scalars_of_numpy_are_numbers():
    center = (np.float32(1.5), np.int64(2), 3)
    changed = change(RUN, {"model.hidden": np.int32(64), "rate": np.float32(0.5), "model.center": center})
    assert (changed.model.hidden, changed.rate, changed.model.center) == (64, 0.5, (1.5, 2.0, 3.0))
    assert type(changed.model.hidden) is int and "hidden = 64" in to_toml(changed)
    with pytest.raises(ConfigError, match="model.hidden is 2.5; must be an integer"):
        change(RUN, {"model.hidden": np.float32(2.5)})


@pytest.mark.parametrize("value", ["3", True, [3], 3j])
def test_what_is_no_number_lies_in_no_range(value):
    with pytest.raises(ConfigError, match=r"minutes is .*; it must be a number"):
        require_range("minutes", value, 1, 5)


def test_whole_numbers_are_of_any_integer_type():
    numbers = whole(0, frames=np.int32(5), nodes=None, seed=0)
    assert numbers == [5, None, 0] and type(numbers[0]) is int
    for value in (1.0, "1", True, np.float64(2), [1]):
        with pytest.raises(ConfigError, match="frames is .*; it must be a whole number"):
            whole(frames=value)
    with pytest.raises(ConfigError, match="frames is 1; it must be at least 2"):
        whole(2, frames=1)


def test_an_empty_table_is_no_value():
    """It was passed over, and the default taken; a group may be empty."""
    assert from_toml(Run, 'data = "d.h5"\n[model]\n') == Run(Model(), "d.h5")
    for text, told in (
        ('data = "d.h5"\nmodel = { hidden = {} }', r"model.hidden is \{\}; must be an integer"),
        ("data = {}", r"data is \{\}; must be a text"),
        ('data = "d.h5"\n[other]\n', "there is no setting other"),
    ):
        with pytest.raises(ConfigError, match=told):
            from_toml(Run, text)
