"""Values that cannot be are refused by name, in Python and on the command line, before anything starts."""

from dataclasses import fields

import draccus
import pytest
from lerobot.configs import FeatureType, PolicyFeature, parser
from lerobot.configs.train import TrainPipelineConfig

from lerobot_deltaco.commands import train as train_command
from lerobot_deltaco.common.typed_fields import in_words, is_a, type_hints
from lerobot_deltaco.configuration_deltaco import RANGES, DeltacoConfig
from lerobot_deltaco.data.collection_plan import CollectionPlan
from lerobot_deltaco.envs.configuration_env import DeltacoEnv
from lerobot_deltaco.evaluation.plan import EvaluationPlan
from lerobot_deltaco.lerobot_internals import reason_of

OWN_FIELDS = type_hints(DeltacoConfig)
NUMBERS = {name: kind for name, kind in OWN_FIELDS.items() if name in RANGES}


def wrong_values(kind):
    """Values that are not of a type."""
    wrong = [None, "x", 1.5, 3, True, [99], {}, float("nan"), float("inf"), b"x", object()]
    return [value for value in wrong if not is_a(value, kind)]


@pytest.mark.parametrize("name", [name for name in OWN_FIELDS if name != "normalization_mapping"])
def test_values_of_another_type_are_refused_by_name(name):
    values = wrong_values(OWN_FIELDS[name])
    assert len(values) > 5
    for value in values:
        with pytest.raises(ValueError, match=f"`{name}` must be"):
            DeltacoConfig(device="cpu", **{name: value})


def test_every_number_has_a_range():
    numbers = {name for name, kind in OWN_FIELDS.items() if is_a(1, kind)}
    assert numbers == {*RANGES, "upsampled_share"}  # which is checked where it is used


@pytest.mark.parametrize("name", RANGES)
def test_numbers_beyond_their_range_are_refused_by_name(name):
    least, greatest = RANGES[name]
    for value in (least - 1, greatest + 1):
        with pytest.raises(ValueError, match=f"`{name}` must be at (least|most)"):
            DeltacoConfig(device="cpu", **{name: value})


@pytest.mark.parametrize(
    "options",
    [
        {"language_head": [0]},
        {"demo_head": [2**31]},
        {"temperature": 1e-40},
        {"seed": 2**63},
        {"image_size": 2**31},
        {"gripper": 1},
        {"upsampled_share": None},
        {"upsampled_share": 0.2, "upsampled_tasks": "wave", "tasks_per_batch": 16},
    ],
    ids=str,
)
def test_absurd_values_are_refused_by_name(options):
    name = next(iter(options))
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        DeltacoConfig(device="cpu", **options)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (["--temperature=inf"], "temperature"),
        (["--seed=-1"], "seed"),
        (["--seed=many"], "seed"),
        (["--image_size=2147483648"], "image_size"),
        (["--optimizer_lr=nan"], "optimizer_lr"),
        (["--demo_rows=0"], "demo_rows"),
        (["--method=best"], "method"),
    ],
)
def test_the_command_line_names_the_field(options, name):
    with pytest.raises(draccus.utils.ParsingError) as error:
        draccus.parse(DeltacoConfig, args=["--device=cpu", *options])
    assert f"`{name}`" in reason_of(error.value)


@pytest.mark.parametrize(
    ("episodes", "is_valid"),
    [(None, True), ([0, 2], True), ([], False), ([99], False), ([-1], False), ([1, 1], False)],
)
def test_episodes_for_demonstrations_are_those_of_the_dataset(episodes, is_valid):
    config = DeltacoConfig(device="cpu", demo_episodes=episodes)
    if is_valid:
        config.check_episodes(3)
    else:
        with pytest.raises(ValueError, match="`demo_episodes` must be different episodes .* 0 to 2"):
            config.check_episodes(3)


@pytest.mark.parametrize("shape", [(4, 2), (), (0,)])
@pytest.mark.parametrize("name", ["action", "observation.state"])
def test_actions_and_states_are_vectors(name, shape):
    shapes = {"action": (4,), "observation.state": (10,), name: shape}
    config = DeltacoConfig(
        device="cpu",
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48)),
            "observation.state": PolicyFeature(FeatureType.STATE, shapes["observation.state"]),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, shapes["action"])},
    )
    with pytest.raises(ValueError, match=rf"`{name}` must be a vector, of the shape \(n,\)"):
        config.resolve(None)


@pytest.mark.parametrize("make", [DeltacoEnv, EvaluationPlan, lambda **kw: CollectionPlan("4", 1, **kw)])
@pytest.mark.parametrize(
    ("name", "value"),
    [("image_size", 48.0), ("image_size", None), ("image_size", 2**31), ("image_size", True)],
)
def test_other_configurations_do_the_same(make, name, value):
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        make(**{name: value})


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (DeltacoEnv, {"episode_length": 2**31}),
        (DeltacoEnv, {"task": 4}),
        (DeltacoEnv, {"fps": 0}),
        (EvaluationPlan, {"trials": 1.0}),
        (EvaluationPlan, {"seed": 2**63}),
        (EvaluationPlan, {"tasks": ["4"]}),
        (lambda **kw: CollectionPlan(**{"tasks": "4", "episodes_per_task": 1, **kw}), {"tasks": ["4"]}),
        (lambda **kw: CollectionPlan(**{"tasks": "4", "episodes_per_task": 1, **kw}), {"noise": "0.1"}),
    ],
)
def test_fields_of_other_configurations_are_named(make, options):
    (name,) = options
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        make(**options)


# Types


@pytest.mark.parametrize(
    ("value", "kind", "expected"),
    [
        (3, int, True),
        (True, int, False),
        (3.0, int, False),
        (3, float, True),
        (float("nan"), float, False),
        (True, bool, True),
        (1, bool, False),
        (None, int | None, True),
        ([1, 2], list[int], True),
        ([1, "2"], list[int], False),
        ((1, 2), list[int], False),
        ({"a": 1}, dict[str, int], True),
        ({1: 1}, dict[str, int], False),
        pytest.param(object(), object, True, id="any object"),
    ],
    ids=str,
)
def test_values_are_of_a_type_or_not(value, kind, expected):
    assert is_a(value, kind) is expected
    assert in_words(kind)


def test_the_types_are_those_of_all_fields_of_ones_own():
    inherited = {field.name for field in fields(DeltacoConfig.__mro__[1])}
    assert set(OWN_FIELDS) | inherited == {field.name for field in fields(DeltacoConfig)}


COMMAND_LINES = [
    (["--policy.type=deltaco", "--policy.optimizer_lr=inf"], "`optimizer_lr` must be a finite number"),
    (["--policy.type=deltaco", "--policy.temperature=1e-40"], "`temperature` must be at least 0.001"),
    (["--env.type=deltaco", "--env.image_size=2147483648"], "`image_size` must be at most"),
]


@pytest.mark.parametrize(("options", "message"), COMMAND_LINES)
def test_lerobots_command_line_names_the_field(options, message, monkeypatch, caplog):
    """LeRobot's parser says no more than which class it cannot make."""

    @parser.wrap()
    def main(config: TrainPipelineConfig):
        return config

    monkeypatch.setattr("sys.argv", ["lerobot-train", "--dataset.repo_id=user/data", *options])
    with pytest.raises(SystemExit):
        main()
    (logged,) = [record for record in caplog.records if record.name.startswith("lerobot_deltaco")]
    assert message in logged.getMessage()


@pytest.mark.parametrize(("options", "message"), COMMAND_LINES)
def test_deltaco_train_ends_with_the_name_of_the_field(options, message, monkeypatch):
    monkeypatch.setattr("sys.argv", ["deltaco-train", "--dataset.repo_id=user/data", *options])
    with pytest.raises(SystemExit, match=f"^deltaco-train: {message}"):
        train_command.main()


def test_in_python_the_exception_alone_names_the_field(caplog):
    with pytest.raises(ValueError, match="`temperature` must be"):
        DeltacoConfig(device="cpu", temperature=1e-40)
    assert caplog.records == []
