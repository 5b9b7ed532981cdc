"""The page without a browser: what its buttons do, with a small untrained policy in the real environment."""

import json
import random
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from small_policies import use_fake_encoder

from gym_deltaco import EPISODE_STEPS
from gym_deltaco.tasks import OBJECTS, TASKS
from lerobot_deltaco.commands import play as play_command
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.evaluation.explanation import GRASP_COLOR, draw_explanation
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.play import engine as engine_module
from lerobot_deltaco.play.checkpoints import find_checkpoint
from lerobot_deltaco.play.engine import Engine
from lerobot_deltaco.play.episodes import MAX_SENTENCE, Demonstration, Player, checked_sentence
from lerobot_deltaco.play.errors import PlayError
from lerobot_deltaco.play.session import Actions, Session
from lerobot_deltaco.play.worker import Worker
from lerobot_deltaco.policy.demonstrations import DemonstrationSet
from lerobot_deltaco.policy.goal_conditioning import FoundGoals

# Two names and a color, each in a container's color and at a place.
DEMONSTRATED = [TASKS[index].instruction for index in (4, 15, 36, 204)]
N_EACH = 2


def save_policy(folder, **options):
    """A checkpoint of an untrained policy with demonstrations of some tasks."""
    torch.manual_seed(0)
    config = DeltacoConfig(
        device="cpu",
        backbone="strided",
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48)),
            "observation.state": PolicyFeature(FeatureType.STATE, (10,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        **{"gripper": "3", **options},
    )
    policy = DeltacoPolicy(config).eval()
    if config.uses_demo:
        frames = torch.randint(0, 256, (len(DEMONSTRATED) * N_EACH, 2, 3, 48, 48), dtype=torch.uint8)
        tasks = [task for task in DEMONSTRATED for _ in range(N_EACH)]
        policy.eval_demonstrations = DemonstrationSet(frames, tasks, range(len(tasks)))
    policy.save_pretrained(folder)
    stats = {"observation.state": {"mean": torch.zeros(10), "std": torch.ones(10)}}
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


pytestmark = pytest.mark.usefixtures("fake_language")


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """A folder of checkpoints: with goals, without, and without demonstrations."""
    folder = tmp_path_factory.mktemp("checkpoints")
    with pytest.MonkeyPatch.context() as monkeypatch:
        use_fake_encoder(monkeypatch)
        save_policy(folder / "goals", demo_encoder="correspondence")
        save_policy(folder / "attention", demo_encoder="attention")
        save_policy(folder / "language", demo_encoder="attention", method="language_only")
    return folder


@pytest.fixture
def engine(checkpoints):
    return Engine(str(checkpoints / "goals"), [checkpoints], is_hub_allowed=False)


@pytest.fixture
def actions(engine):
    return Actions(engine, random.Random(0))


@pytest.fixture
def session(actions, engine):
    opened = actions.open_checkpoint(Session(), engine.default_checkpoint)
    return actions.choose_scene(opened, 4, 3)


def last(sessions):
    *_, session = sessions
    return session


# Drawing


def goals_at(column, row, size=24):
    maps = torch.full((1, 2, size, size), -20.0)
    maps[0, :, row, column] = 20
    places = torch.tensor([[[(column + 0.5) / size * 2 - 1, (row + 0.5) / size * 2 - 1]] * 2])
    return FoundGoals(places, None, maps, maps.flatten(2).softmax(dim=2).view_as(maps))


def pinkness(image, x, y):
    """How close a pixel is to the color of the grasp, 0..1."""
    return 1 - np.abs(image[y, x].astype(float) - GRASP_COLOR).mean() / 255


def test_a_map_is_drawn_where_it_is_great():
    size, scene = 240, np.full((48, 48, 3), 120, np.uint8)
    ends = np.stack([scene, scene])
    image = draw_explanation(scene, ends, goals_at(6, 18), panel_size=size)
    assert image.dtype == np.uint8
    assert image.shape[1] > 3 * size
    assert pinkness(image, 65, 185) > pinkness(image, 185, 65) + 0.2
    plain = draw_explanation(scene, ends, None, panel_size=size)
    assert (plain[:size, :size] == 120).all()


def test_attention_is_not_drawn_where_the_demonstration_does_not_matter():
    scene = np.full((48, 48, 3), 120, np.uint8)
    image = draw_explanation(scene, np.stack([scene, scene]), goals_at(6, 18), (True, False), panel_size=96)
    assert not (image[:96, :96] == 120).all()
    second = image[:96, 96 + 8 : 2 * 96 + 8]
    assert (second == 120).all()


def test_a_scene_alone_is_one_panel():
    scene = np.zeros((48, 48, 3), np.uint8)
    assert draw_explanation(scene, None, None, panel_size=100).shape[1] == 100


# The worker


def test_a_stream_stays_in_one_thread_and_raises_its_errors():
    def generate():
        yield threading.get_ident()
        yield threading.get_ident()
        raise PlayError("enough")

    stream = Worker().stream(generate)
    first, second = next(stream), next(stream)
    assert first == second != threading.get_ident()
    with pytest.raises(PlayError, match="enough"):
        next(stream)


def test_a_stream_that_is_left_is_closed_and_the_next_one_runs():
    worker, is_closed = Worker(), threading.Event()

    def generate():
        try:
            while True:
                yield 1
        finally:
            is_closed.set()

    stream = worker.stream(generate)
    assert next(stream) == 1
    stream.close()
    assert is_closed.wait(30)
    assert worker.call(lambda: 2) == 2


# Checkpoints


def damaged(checkpoints, tmp_path, file, change):
    folder = tmp_path / "damaged"
    shutil.copytree(checkpoints / "goals", folder)
    content = json.loads((folder / file).read_text())
    change(content)
    (folder / file).write_text(json.dumps(content))
    return folder


def test_a_checkpoint_is_found_in_an_allowed_folder_alone(checkpoints, tmp_path):
    folder = checkpoints / "goals"
    assert find_checkpoint(f" {folder} ", [checkpoints], False) == folder.resolve()
    for name in (str(folder), "/etc", "~root", f"{tmp_path}/../..", "a\0b", "x" * 9999, "USER/NAME"):
        with pytest.raises(PlayError, match="no checkpoint .* may load"):
            find_checkpoint(name, [tmp_path], False)
    with pytest.raises(PlayError, match="is empty"):
        find_checkpoint("  ", [tmp_path], True)


def test_a_link_does_not_lead_out_of_an_allowed_folder(checkpoints, tmp_path):
    (tmp_path / "link").symlink_to(checkpoints / "goals")
    with pytest.raises(PlayError, match="no checkpoint"):
        find_checkpoint(str(tmp_path / "link"), [tmp_path], False)


def test_a_repository_that_cannot_be_fetched_is_explained():
    with pytest.raises(PlayError, match="'USER/NAME' .*Hub"):
        find_checkpoint("USER/NAME", [], True)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (
            "policy_preprocessor.json",
            lambda content: content["steps"].insert(0, {"class": "os.system", "config": {}}),
            "asks for the step 'os.system'",
        ),
        (
            "policy_postprocessor.json",
            lambda content: content["steps"][0].update(registry_name="other_step"),
            "asks for the step 'other_step'",
        ),
        (
            "policy_preprocessor.json",
            lambda content: content["steps"][-1].update(state_file="../../secret.safetensors"),
            "names the file",
        ),
        ("policy_preprocessor.json", lambda content: content.update(steps=3), "no list of steps"),
        ("config.json", lambda content: content.update(type="act"), "of the type 'act'"),
        ("config.json", lambda content: content.update(demo_root="/etc"), "`demo_root`"),
    ],
)
def test_a_checkpoint_that_could_run_code_or_read_files_is_refused(
    checkpoints, tmp_path, file, change, message
):
    folder = damaged(checkpoints, tmp_path, file, change)
    with pytest.raises(PlayError, match=message):
        find_checkpoint(str(folder), [tmp_path], False)


def test_a_broken_checkpoint_is_explained(checkpoints, tmp_path):
    folder = damaged(checkpoints, tmp_path, "config.json", lambda content: content.update(method="magic"))
    with pytest.raises(PlayError, match="cannot be loaded .*magic"):
        Player(folder)
    (folder / "config.json").write_text("{")
    with pytest.raises(PlayError, match=r"config.json cannot be read"):
        find_checkpoint(str(folder), [tmp_path], False)
    (folder / "model.safetensors").unlink()
    with pytest.raises(PlayError, match=r"model.safetensors is missing"):
        find_checkpoint(str(folder), [tmp_path], False)


def test_an_engine_says_why_it_cannot_start(checkpoints):
    engine = Engine(str(checkpoints / "nowhere"), [checkpoints], is_hub_allowed=False)
    engine._start()
    assert engine.status.is_done
    assert not engine.status.is_ready
    assert "nowhere" in engine.status.text


def test_an_engine_becomes_ready_in_the_background(engine):
    threads = torch.get_num_threads()
    try:
        engine.start()
        while not engine.status.is_done:
            threading.Event().wait(0.05)
        assert engine.status.is_ready
    finally:
        torch.set_num_threads(threads)


def test_an_engine_keeps_few_checkpoints(checkpoints, engine, monkeypatch):
    monkeypatch.setattr(engine_module, "MAX_LOADED", 1)
    for name in ("goals", "language"):
        engine.load(str(checkpoints / name))
    assert list(engine._players) == [str(checkpoints / "language")]


# Sessions


def test_a_session_begins_with_a_scene_and_its_demonstration(actions, engine):
    session = actions.open_checkpoint(Session(), engine.default_checkpoint)
    assert TASKS[session.scene.task_id].instruction in DEMONSTRATED
    assert session.demonstrated[0] == session.sentence == TASKS[session.scene.task_id].instruction
    assert session.demonstration.ends.shape == (2, 48, 48, 3)
    assert len(session.view.objects) == 3


def test_a_run_shows_every_step_and_what_happened(actions, session):
    sessions = list(actions.run(session, " put it over there "))
    assert len(sessions) == 1 + EPISODE_STEPS
    run = sessions[-1].latest
    assert "Instruction: put it over there\n" in run.title
    assert "uccess" in run.moment.text
    assert run.moment.view.shape[1] > 3 * 200  # two images of the demonstration, and the scene
    assert not np.array_equal(sessions[0].latest.moment.image, run.moment.image)
    assert sessions[-1].sentence == "put it over there"


def test_a_run_repeats_itself_and_leaves_the_checkpoints_demonstrations(actions, engine, session):
    first, second = (last(actions.run(session, "go")).latest.moment for _ in range(2))
    assert np.array_equal(first.image, second.image)
    assert first.text == second.text
    counts = engine.call(engine.default_checkpoint, lambda player: player.demonstrated_tasks)
    assert counts == dict.fromkeys(DEMONSTRATED, N_EACH)


def test_a_swapped_demonstration_runs_in_the_same_scene_beside_the_last_run(actions, session):
    session = last(actions.run(session, "go"))
    swapped = last(actions.run_with_other_demonstration(session, "go"))
    assert swapped.earlier == session.latest
    assert swapped.scene == session.scene
    assert swapped.demonstrated[0] != session.demonstrated[0]
    assert not np.array_equal(swapped.latest.moment.view, session.latest.moment.view)


def test_a_swapped_instruction_makes_sense_in_the_scene_and_swaps_back(actions, session):
    swapped = last(actions.run_with_other_sentence(session))
    assert swapped.demonstrated == session.demonstrated
    labels = [OBJECTS[index] for index in session.view.info["objects"]]
    other = next(task for task in TASKS if task.instruction == swapped.sentence)
    assert other.index != session.scene.task_id
    assert any(other.describes(label) for label in labels)
    back = last(actions.run_with_other_sentence(swapped))
    assert back.sentence == TASKS[session.scene.task_id].instruction


def test_the_experts_episode_becomes_the_demonstration(actions, session):
    with pytest.raises(PlayError, match="Let the expert do it first"):
        actions.use_recorded(session)
    session = last(actions.run_expert(session))
    assert "Success. It grasped the smushed dumbbell" in session.latest.moment.text
    session = actions.use_recorded(session)
    assert isinstance(session.demonstration, Demonstration)
    assert session.demonstrated is None
    changed = np.abs(np.diff(session.demonstration.ends.astype(int), axis=0)).max()
    assert changed > 50
    assert "uccess" in last(actions.run(session, "go")).latest.moment.text


@pytest.mark.parametrize(("name", "n_panels"), [("attention", 3), ("language", 1)])
def test_other_policies_show_what_they_receive(checkpoints, actions, name, n_panels):
    session = actions.open_checkpoint(Session(), str(checkpoints / name))
    moment = last(actions.run(session, "go")).latest.moment
    assert moment.view.shape[1] == n_panels * 224 + (n_panels - 1) * 8


def test_two_users_do_not_mix(actions, session):
    others = actions.choose_demonstration(actions.choose_scene(session, 204, 8), DEMONSTRATED[3], 2)
    alone = [last(actions.run(each, "go")).latest for each in (session, others)]
    together = [None, None]

    def run(number, each):
        together[number] = last(actions.run(each, "go")).latest

    threads = [threading.Thread(target=run, args=pair) for pair in enumerate((session, others))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for mine, expected in zip(together, alone, strict=True):
        assert mine.title == expected.title
        assert np.array_equal(mine.moment.image, expected.moment.image)
        assert np.array_equal(mine.moment.view, expected.moment.view)


# Bad input


@pytest.mark.parametrize(
    ("sentence", "message"),
    [
        ("", "is empty"),
        (" \n ", "is empty"),
        (None, "is empty"),
        ("x" * (MAX_SENTENCE + 1), f"at most {MAX_SENTENCE} characters"),
        ("put\nit", "line breaks"),
        ("put \x07 it", "not printed"),
    ],
)
def test_a_bad_sentence_is_refused(sentence, message):
    with pytest.raises(PlayError, match=message):
        checked_sentence(sentence)


def test_a_sentence_is_data():
    assert (
        checked_sentence(" <img src=x onerror=alert(1)> {{7*7}} ") == "<img src=x onerror=alert(1)> {{7*7}}"
    )


@pytest.mark.parametrize("seed", [None, "x", -1, 1.5, float("nan"), float("inf"), 2**40])
def test_a_bad_seed_is_refused(actions, session, seed):
    with pytest.raises(PlayError, match="seed must be an integer"):
        actions.choose_scene(session, 4, seed)


def test_a_demonstration_that_does_not_exist_is_refused(actions, session):
    with pytest.raises(PlayError, match="has the demonstrations 1 to 2. Got 3"):
        actions.choose_demonstration(session, DEMONSTRATED[0], 3)
    with pytest.raises(PlayError, match="no demonstration of 'wave'"):
        actions.choose_demonstration(session, "wave", 1)


def test_nothing_runs_before_a_checkpoint_is_loaded(actions):
    with pytest.raises(PlayError, match="No checkpoint is loaded yet"):
        last(actions.run(Session(), "go"))


# The command


def test_the_command_says_that_the_projects_checkpoint_is_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(play_command, "checkpoints_folder", lambda: tmp_path)
    with pytest.raises(SystemExit) as exit_:
        play_command.main([])
    assert exit_.value.code == 2
    assert f"not at {tmp_path}" in capsys.readouterr().err


def test_the_page_stands_before_anything_heavy_is_imported():
    code = (
        "import sys, lerobot_deltaco.play.session, lerobot_deltaco.commands.play; "
        "print({'torch', 'lerobot', 'pybullet'} & set(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "set()"


def test_the_space_begins_with_the_projects_checkpoint():
    space = Path(__file__).parents[1] / "space"
    assert compile((space / "app.py").read_text(), "app.py", "exec")
    assert "lerobot_policy_deltaco[play,offline,sim]" in (space / "requirements.txt").read_text()
    card = (space / "README.md").read_text()
    assert "sdk: gradio" in card
    assert "app_file: app.py" in card
