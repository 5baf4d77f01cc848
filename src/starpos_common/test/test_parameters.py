# SPDX-License-Identifier: Apache-2.0
"""Declaring, refusing and changing parameters on a real node."""

import math

import pytest
import rclpy
import rclpy.parameter
import yaml

from starpos.parameters.table import FRAME_NAME, Parameter, ParameterError, yaml_value
from starpos_common.parameters import declare, warn_of_unknown
from starpos_testing.nodes import take_domain

TABLE = (
    Parameter("rate", 10, "Samples a second.", unit="Hz", minimum=1, maximum=50),
    Parameter("noise", 0.5, "White noise.", unit="deg", minimum=0.0, maximum=10.0),
    Parameter("cadence", 1.0, "Time between frames.", unit="s", minimum=0.0),
    Parameter(
        "altitude",
        math.nan,
        "Height; wrong by 1 km is wrong by 1 km.",
        unit="m",
        minimum=-500.0,
        maximum=9000.0,
    ),
    Parameter("refraction.pressure", 1.0e5, "Air pressure.", unit="Pa"),
    Parameter("offsets", (2.5, 2.5), "Of x and y.", unit="V", minimum=0.0, maximum=5.0),
    Parameter("source", "files", "Where frames come from.", choices=("files", "simulated")),
    Parameter("loop", False, "Begin anew at the end."),
    Parameter("frame_id", "starpos_link", "Frame of the fix.", form=FRAME_NAME),
    Parameter("port", "/dev/x", 'The "port".', read_only=True),
)


# name:=value as in YAML, and the sentence
REFUSED = (
    ("rate:=51", "rate must be a whole number from 1 to 50 Hz; 51 was given."),
    ("rate:=2.5", "rate must be a whole number from 1 to 50 Hz; 2.5 was given."),
    ("rate:=true", "rate must be a whole number from 1 to 50 Hz; True was given."),
    ("noise:=-1", "noise must be a number from 0 to 10 deg; -1 was given."),
    ("noise:=10.1", "noise must be a number from 0 to 10 deg; 10.1 was given."),
    ("noise:=.nan", "noise must be a number from 0 to 10 deg; nan was given."),
    ("noise:=much", "noise must be a number from 0 to 10 deg; 'much' was given."),
    ("noise:=[1.0]", "noise must be a number from 0 to 10 deg; [1.0] was given."),
    ("cadence:=-1.0", "cadence must be a number of at least 0 s; -1.0 was given."),
    ("cadence:=.inf", "cadence must be a number of at least 0 s; inf was given."),
    (
        "altitude:=100000.0",
        "altitude must be a number from -500 to 9000 m, or nan for unset; 100000.0 was given.",
    ),
    ("refraction.pressure:=high", "refraction.pressure must be a number in Pa; 'high' was given."),
    ("offsets:=[1.0]", "offsets must be 2 values, each a number from 0 to 5 V; [1.0] was given."),
    ("offsets:=[1.0, 9.0]", "offsets must be 2 values, each a number from 0 to 5 V; [1.0, 9.0] was given."),
    ("offsets:=[1.0, .nan]", "offsets must be 2 values, each a number from 0 to 5 V; [1.0, nan] was given."),
    ("offsets:=1.0", "offsets must be 2 values, each a number from 0 to 5 V; 1.0 was given."),
    ("source:=moon", "source must be one of files, simulated; 'moon' was given."),
    ("source:=3", "source must be one of files, simulated; 3 was given."),
    ("loop:=1", "loop must be true or false; 1 was given."),
    (
        "frame_id:=/map",
        "frame_id must be a frame's name, not empty, without blanks, control characters or a leading /; "
        "'/map' was given.",
    ),
)


@pytest.fixture(scope="module")
def context():
    take_domain()
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


@pytest.fixture
def make(context):
    nodes = []

    def make(*overrides, file=None, **options):
        arguments = ["--ros-args", *(word for o in overrides for word in ("-p", o))]
        arguments += ["--params-file", str(file)] if file else []
        nodes.append(rclpy.create_node("params", context=context, cli_args=arguments))
        return nodes[-1], declare(nodes[-1], TABLE, **options)

    yield make
    for node in nodes:
        node.destroy_node()


def change(node, **values):
    return node.set_parameters_atomically([rclpy.parameter.Parameter(k, value=v) for k, v in values.items()])


def test_defaults_and_overrides_have_the_types_of_the_table(make):
    _, values = make("noise:=2", "offsets:=[1, 2]", "altitude:=100")
    assert values["noise"] == 2.0 and type(values["noise"]) is float
    assert values["offsets"] == (1.0, 2.0)
    assert values["altitude"] == 100.0
    assert math.isnan(make()[1]["altitude"])
    assert dict(values).keys() == {p.name for p in TABLE}


@pytest.mark.parametrize(("override", "sentence"), REFUSED)
def test_bad_start_values_are_refused_with_the_constraint(make, override, sentence):
    with pytest.raises(ParameterError) as error:
        make(override)
    assert str(error.value) == f"parameter {sentence}"


def test_a_mistyped_name_is_a_warning_with_the_nearest_one(make, tmp_path, capfd):
    node, _ = make("noise:=2.0", "use_sim_time:=false")
    warn_of_unknown([node])
    assert capfd.readouterr().err == ""
    file = tmp_path / "mine.yaml"
    file.write_text("/**/params:\n  ros__parameters:\n    refraction: {pressures: 95000.0}\n    bogus: 3\n")
    node, values = make("nois:=2.0", file=file)
    warn_of_unknown([node])
    said = capfd.readouterr().err
    assert values["refraction.pressure"] == 1.0e5 and said.count("is ignored") == 3
    assert "no parameter refraction.pressures, it is ignored: did you mean refraction.pressure?" in said
    assert "no parameter nois, it is ignored: did you mean noise?" in said
    assert "no parameter bogus, it is ignored: see `ros2 param list`" in said


def test_what_is_meant_for_another_node_of_the_process_is_no_mistyped_name(context, tmp_path, capfd):
    file = tmp_path / "mine.yaml"
    file.write_text("/**/second:\n  ros__parameters:\n    noise: 3.0\n")
    arguments = ["--ros-args", "-p", "noise:=2.0", "-p", "depth:=3", "--params-file", str(file)]
    rclpy.init(args=arguments, context=(both := rclpy.Context()))
    nodes = [rclpy.create_node(name, context=both) for name in ("first", "second")]
    declare(nodes[0], TABLE[1:2])
    declare(nodes[1], (Parameter("depth", 1, "Of another."),))
    warn_of_unknown(nodes)
    # A -p reaches both.
    assert capfd.readouterr().err == ""
    misplaced = rclpy.create_node(
        "second", context=context, cli_args=["--ros-args", "--params-file", str(file)]
    )
    beside, _ = rclpy.create_node("third", context=context), declare(misplaced, TABLE[:1])
    declare(beside, TABLE[1:2])
    warn_of_unknown([misplaced, beside])
    assert "[second]: there is no parameter noise" in capfd.readouterr().err
    for node in (*nodes, misplaced, beside):
        node.destroy_node()
    rclpy.shutdown(context=both)


def test_descriptors_say_what_and_how_far(make):
    node, _ = make()
    describe = node.describe_parameter
    assert describe("noise").description == "White noise. [deg]"
    assert describe("rate").integer_range[0].to_value == 50
    assert describe("noise").floating_point_range[0].to_value == 10.0
    assert describe("cadence").floating_point_range[0].to_value == math.inf
    assert not describe("altitude").floating_point_range
    assert "or nan for unset" in describe("altitude").additional_constraints
    assert describe("port").read_only and not describe("rate").read_only
    assert not any(describe(p.name).dynamic_typing for p in TABLE)


def test_changes_are_validated_then_applied(make):
    applied = []
    node, values = make(apply=lambda names: applied.append((names, values["noise"])))
    assert change(node, noise=3, altitude=5).successful
    assert applied == [({"noise", "altitude"}, 3.0)]
    assert values["altitude"] == 5.0
    assert change(node, altitude=math.nan).successful
    assert change(node, port="/dev/y").reason == "Trying to set a read-only parameter: port."
    assert not change(node, noise=4.0, rate=99).successful
    assert values["noise"] == 3.0
    assert len(applied) == 2


@pytest.mark.parametrize(("override", "sentence"), REFUSED)
def test_a_change_is_refused_in_the_sentence_of_the_start(make, override, sentence):
    applied = []
    name, _, value = override.partition(":=")
    node, _ = make(apply=applied.append)
    before = node.get_parameter(name).value, node.describe_parameter(name)
    result = change(node, **{name: yaml.safe_load(value)})
    assert not result.successful and result.reason == f"parameter {sentence}"
    assert str(before) == str((node.get_parameter(name).value, node.describe_parameter(name)))
    assert applied == []


@pytest.mark.parametrize(
    "name", ["", " ", "/", "/map", "a b", "a\n", "\tmap", "a\x00", "a\x7f", "a\u00a0b", "a\u202eb"]
)
def test_no_frame_has_such_a_name(name):
    frame_id = next(p for p in TABLE if p.name == "frame_id")
    with pytest.raises(ParameterError, match="without blanks, control characters or a leading /"):
        frame_id.convert(name)


@pytest.mark.parametrize("name", ["map", "rover/starpos_link", "a-b.c:d", "Zürich"])
def test_such_names_frames_have(name):
    assert next(p for p in TABLE if p.name == "frame_id").convert(name) == name


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("frame_id", "x" * 10_000_000, "leading /; a value of 10000000 characters, over 4096, was given."),
        ("frame_id", ["x" * 10_000_000], "leading /; ['xxx"),
        ("frame_id", [0.5] * 1_250_000, "leading /; a value of 1250000 values, over 4096, was given."),
        ("offsets", [0.5] * 1_250_000, "a value of 1250000 values, over 4096, was given."),
        ("offsets", ["x" * 5_000_000] * 2, "must be 2 values, each a number from 0 to 5 V; ['xxx"),
    ],
    ids=["text", "text in a list", "numbers", "numbers for two", "texts for two"],
)
def test_ten_megabytes_are_refused_in_a_short_sentence(make, name, value, words):
    parameter = next(p for p in TABLE if p.name == name)
    with pytest.raises(ParameterError) as raised:
        parameter.convert(value)
    node, _ = make()
    before = node.get_parameter(name).value
    result = change(node, **{name: value})
    assert not result.successful and result.reason == str(raised.value)
    assert words in result.reason and len(result.reason) < 400
    assert node.get_parameter(name).value == before


def test_a_parameter_cannot_be_taken_away(make):
    node, values = make()
    result = node.set_parameters_atomically(
        [rclpy.parameter.Parameter("noise", rclpy.parameter.Parameter.Type.NOT_SET)]
    )
    assert "parameter noise must be a number from 0 to 10 deg" in result.reason and values["noise"] == 0.5


def test_values_must_fit_together(make):
    def check(values, names):
        told.append(names)
        return "noise must not exceed cadence." if values["noise"] > values["cadence"] else None

    told = []
    with pytest.raises(ParameterError, match="must not exceed"):
        make("noise:=2.0", check=check)
    assert told == [{p.name for p in TABLE}]
    node, _ = make(check=check)
    assert change(node, noise=2.0).reason == "noise must not exceed cadence."
    assert change(node, noise=2.0, cadence=3.0).successful
    # Those that are set: what a file held may be read again for them.
    assert told[-1] == {"noise", "cadence"}


def test_a_check_that_fails_refuses_the_change_and_the_node_lives(make):
    def check(values, names):
        return 1 / (values["noise"] - 3.0) and None

    node, values = make(check=check)
    result = change(node, noise=3.0)
    assert not result.successful and "could not be checked (ZeroDivisionError" in result.reason
    assert values["noise"] == 0.5 and change(node, noise=4.0).successful


def test_other_parameters_of_the_node_are_left_alone(make):
    node, _ = make(apply=lambda names: pytest.fail("not ours"))
    node.declare_parameter("theirs", 1)
    assert change(node, theirs=2).successful


@pytest.mark.parametrize("value", [(2.5, 2.5), "/dev/x", 'The "port" \\', False, 1e-9, 1e5, 7, ""])
def test_a_default_is_written_as_yaml_that_rcl_reads(value):
    text = yaml_value(value)
    read = yaml.safe_load(text)
    assert (tuple(read) if isinstance(read, list) else read) == value and type(read) in (type(value), list)
    assert isinstance(value, str) or "e-" not in text


def test_a_rule_states_the_constraint_and_whether_it_is_fixed():
    rules = {p.name: p.rule for p in TABLE}
    assert rules["rate"] == "rate must be a whole number from 1 to 50 Hz."
    assert "fixed while the node runs" in rules["port"]
