"""Matching by pretrained features: the encoder, the fit, and policies with it."""

import copy
import json
import shutil

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from safetensors.torch import load_file, save_file
from small_policies import batch_of, observation, small_policy
from test_correspondence import random_moves, table_dataset

from lerobot_deltaco.commands import match
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.goals.conditioning import Demonstrations, GoalConditioning
from lerobot_deltaco.policy.goals.correspondence import peak_places
from lerobot_deltaco.policy.goals.efficientnet_lite import COARSE_CHANNELS, FINE_CHANNELS, EfficientNetLite
from lerobot_deltaco.policy.goals.matching_fit import fit_matching
from lerobot_deltaco.policy.goals.pretrained_matching import PretrainedMatching
from lerobot_deltaco.policy.goals.words import KnownWords, known_words, vocabulary_of
from lerobot_deltaco.policy.vision import load_efficientnet_lite0

pytestmark = pytest.mark.usefixtures("fake_language")

SIZE = 48
TASKS = ["move the ring left", "move the cross right"]
WITHOUT = {"demo_encoder": "correspondence", "image_size": SIZE, "motion_modes": 2}
MATCHING = {**WITHOUT, "pretrained_matching": True}


def drawn(*things):
    """A gray table with rings and crosses of 9 x 9 px and one color, at their middles (x, y) in -1..1."""
    image = np.full((SIZE, SIZE, 3), 150, np.uint8)
    y, x = np.mgrid[-4:5, -4:5]
    masks = {
        "ring": (np.hypot(x, y) < 4.6) & (np.hypot(x, y) > 2.2),
        "cross": (abs(x) < 1.5) | (abs(y) < 1.5),
    }
    for kind, middle in things:
        column, row = (round((c + 1) * SIZE / 2) for c in middle)
        image[row - 4 : row + 5, column - 4 : column + 5][masks[kind]] = (60, 90, 160)
    return image


def kinds_of(task):
    """What a task moves, and what else lies there."""
    return ("ring", "cross") if "ring" in task else ("cross", "ring")


def drawn_table(task, thing, other):
    kinds = kinds_of(task)
    return drawn((kinds[0], thing), (kinds[1], other))


@pytest.fixture(scope="module")
def episodes():
    return random_moves(TASKS)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, episodes):
    return table_dataset(tmp_path_factory.mktemp("data") / "table", episodes, image=drawn_table)


@pytest.fixture(scope="module")
def examples(episodes):
    images = torch.tensor(np.stack([drawn_table(*episode[:3]) for episode in episodes]))
    places = torch.tensor(np.stack([episode[1] for episode in episodes]), dtype=torch.float32)
    return images.permute(0, 3, 1, 2).contiguous(), places, [episode[0] for episode in episodes]


@pytest.fixture(scope="module")
def published():
    return load_efficientnet_lite0().eval()


def new_matching(published, detail=1, n_words=0):
    matching = PretrainedMatching(n_words, detail=detail)
    matching.encoder.take_weights(published.state_dict())
    return matching


# The encoder


def test_the_maps_are_those_of_the_package(published):
    encoder = EfficientNetLite()
    encoder.take_weights(published.state_dict())
    images = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    fine, coarse = encoder.fine_maps(images), encoder.coarse_maps(images)
    maps = published._swish(published._bn0(published._conv_stem((images - encoder.mean) / encoder.std)))
    theirs = []
    with torch.no_grad():
        for block in published._blocks[:7]:
            maps = block(maps)
            theirs.append(maps)
    assert fine.shape == (2, FINE_CHANNELS, 8, 12)
    assert coarse.shape == (2, COARSE_CHANNELS, 4, 6)
    torch.testing.assert_close(fine, theirs[4], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(coarse, theirs[6], atol=1e-5, rtol=1e-5)


def test_weights_of_another_network_are_refused():
    with pytest.raises(ValueError, match="not the weights of EfficientNet-Lite0: there are 2 tensors"):
        EfficientNetLite().take_weights(torch.nn.Sequential(torch.nn.Conv2d(3, 8, 3)).state_dict())
    with pytest.raises(ValueError, match="not the weights of EfficientNet-Lite0: 0 has the shape"):
        EfficientNetLite().take_weights({str(number): torch.zeros(2) for number in range(500)})


def test_nothing_of_it_is_trained_with_a_policy():
    matching = PretrainedMatching().train()
    assert not any(weights.requires_grad for weights in matching.parameters())
    assert not any(module.training for module in matching.encoder.modules())


# The fit


def share_found(matching, images, places, tasks):
    """Share of the episodes in which the next one of the task finds what is to be grasped."""
    following = [
        next(row for row in [*range(n + 1, len(tasks)), *range(n)] if tasks[row] == tasks[n])
        for n in range(len(tasks))
    ]
    maps = matching.normalized(matching.encode(images.float() / 255))
    found = matching.find(maps, matching.describe(maps.rows(torch.tensor(following)), places[following]))
    return share_at(found, places)


def share_at(logits, places):
    """Share of the maps (batch, h, w) whose peak is near a place."""
    return ((peak_places(logits[:, None])[:, 0] - places).abs().amax(dim=1) < 0.2).float().mean()


def test_a_fit_finds_shapes_of_one_color(published, examples):
    matching = new_matching(published)
    images, places, tasks = examples
    fit_matching(matching, images[:40], places[:40], tasks[:40], None, seed=0, steps=60)
    assert matching.fitted
    assert share_found(matching, images[40:], places[40:], tasks[40:]) >= 0.9


def test_a_fit_is_a_function_of_its_seed(published, examples):
    tasks = examples[2][:8]
    words = known_words(vocabulary_of(tasks), tasks).present
    fitted = []
    for seed in (0, 0, 1):
        matching = new_matching(published, n_words=words.shape[1])
        fit_matching(matching, *(part[:8] for part in examples), words, seed=seed, steps=2)
        fitted.append(dict(matching.named_parameters()))
    learned = [name for name in fitted[0] if not name.startswith("encoder.")]
    assert len(learned) == 15  # of two networks: 6 weights and biases, and a scale; and the words
    assert all(torch.equal(fitted[0][name], fitted[1][name]) for name in learned)
    drawn = [name for name in learned if "log_scale" not in name]
    assert not any(torch.equal(fitted[0][name], fitted[2][name]) for name in drawn)


def test_what_is_around_a_place_counts(published, examples):
    matching = new_matching(published)
    fit_matching(matching, *(part[:8] for part in examples), None, seed=0, steps=2)
    maps = matching.normalized(matching.encode(examples[0][:1].float() / 255))
    changed = maps.rows(torch.tensor([0]))
    changed.coarse[..., 5, 6] += 1
    differs = (matching.demo(maps) != matching.demo(changed)).any(dim=1)[0]
    assert differs[10, 10]  # in the cell beside
    assert not differs[20, 20]


def test_loading_the_encoder_draws_nothing():
    before = torch.get_rng_state()
    load_efficientnet_lite0()
    assert torch.equal(torch.get_rng_state(), before)


def test_words_that_are_fitted_find_what_they_name(published, examples):
    images, places, tasks = examples
    vocabulary = vocabulary_of(tasks)
    matching = new_matching(published, n_words=len(vocabulary))
    words = known_words(vocabulary, tasks).present
    fit_matching(matching, images[:40], places[:40], tasks[:40], words[:40], seed=0, steps=60)
    maps = matching.normalized(matching.encode(images[40:].float() / 255))
    assert share_at(matching.find_named(maps, words[40:]), places[40:]) >= 0.9
    # In words that were never put like this.
    other = known_words(vocabulary, ["ring" if "ring" in task else "CROSS!" for task in tasks[40:]])
    assert share_at(matching.find_named(maps, other.present), places[40:]) >= 0.9


def test_words_are_known_or_not():
    vocabulary = vocabulary_of(["Put the red cup in.", "Put 2 bowls in."])
    assert vocabulary == ["bowls", "cup", "in", "put", "red", "the"]
    known = known_words(vocabulary, ["put RED bowls, in!", "put the jar in", ""])
    assert known.present.sum(dim=1).tolist() == [4, 3, 0]
    assert known.are_all.tolist() == [True, False, False]
    assert known_words(vocabulary, []).present.shape == (0, 6)


def test_only_so_many_episodes_are_fitted_to(published, examples, monkeypatch):
    monkeypatch.setattr("lerobot_deltaco.policy.goals.matching_fit._MAX_EPISODES", 6)
    matching, seen = new_matching(published), []
    encode = matching.encode
    monkeypatch.setattr(matching, "encode", lambda images: seen.append(len(images)) or encode(images))
    fit_matching(matching, *examples, None, seed=0, steps=1)
    assert sum(seen) == 6


def test_larger_images_give_maps_of_the_same_size(published, examples):
    images = examples[0][:2].float() / 255
    larger = torch.nn.functional.interpolate(images, scale_factor=2)
    plain, detailed = new_matching(published).encode(images), new_matching(published, 2).encode(larger)
    for maps in (plain, detailed):
        assert maps.fine.shape == (2, FINE_CHANNELS, SIZE // 4, SIZE // 4)
        assert maps.coarse.shape == (2, COARSE_CHANNELS, SIZE // 4, SIZE // 4)


def test_the_maps_of_large_images_stop_growing(published, examples):
    large = torch.nn.functional.interpolate(examples[0][:1].float() / 255, size=(256, 192))
    maps = new_matching(published).encode(large)
    assert maps.fine.shape[-2:] == maps.coarse.shape[-2:] == (24, 24)
    small = new_matching(published).encode(torch.nn.functional.interpolate(large, size=(96, 96)))
    assert torch.nn.functional.cosine_similarity(maps.fine.flatten(), small.fine.flatten(), dim=0) > 0.9


@pytest.mark.slow
def test_a_fit_to_large_images_finds_shapes_of_one_color(published, examples):
    images, places, tasks = (part[:24] for part in examples)
    images = torch.nn.functional.interpolate(images, size=(256, 256))
    matching = new_matching(published)
    fit_matching(matching, images[:16], places[:16], tasks[:16], None, seed=0, steps=60)
    assert share_found(matching, images[16:], places[16:], tasks[16:]) >= 0.9


def test_episodes_without_a_grasp_do_not_count(published, examples):
    images, places, tasks = (part[:6] for part in examples)
    places = torch.where(torch.arange(6)[:, None] < 2, places, torch.nan)
    with pytest.raises(ValueError, match="at least two episodes .* 2 such episodes are of 2 different tasks"):
        fit_matching(new_matching(published), images, places, tasks, None, seed=0, steps=2)


# Which maps count


class FixedMatching:
    """Finds what a demonstration moved at the first place of four, and what words name at the last."""

    named = "something"
    encode = normalized = staticmethod(lambda images: images)
    describe = staticmethod(lambda maps, places: torch.zeros(len(maps), 1))
    find = staticmethod(
        lambda maps, descriptors: torch.tensor([[3.0, 0, 0, 0]]).expand(len(maps), 4)[:, None]
    )
    find_named = staticmethod(
        lambda maps, present: torch.tensor([[0.0, 0, 0, 3]]).expand(len(maps), 4)[:, None]
    )


def matched(demonstrations, words):
    scenes, located = torch.zeros(2, 3, 1, 4), torch.zeros(2, 1, 4)
    attention = torch.ones(2, 2, 1, 4) / 4
    maps = GoalConditioning._matched(FixedMatching, located, scenes, demonstrations, attention, words)
    assert maps.shape == located.shape
    return maps.flatten(1).argmax(dim=1).tolist()


def test_an_instruction_with_unknown_words_counts_only_without_a_demonstration():
    shown = Demonstrations(torch.zeros(2, 1, 2, 3, 1, 4), torch.zeros(2, 1))
    words = KnownWords(torch.ones(2, 5), torch.tensor([True, False]))
    assert matched(shown, words) == [3, 0]
    assert matched(shown, None) == [0, 0]
    assert matched(None, words) == [3, 3]
    found = GoalConditioning._matched(
        FixedMatching, torch.zeros(2, 1, 4), torch.zeros(2, 3, 1, 4), None, None, words
    )
    named = FixedMatching.find_named(torch.zeros(2), None).flatten(1).log_softmax(dim=1)
    torch.testing.assert_close(found[:, 0].log_softmax(dim=1), (3 * named).log_softmax(dim=1))
    none = KnownWords(torch.zeros(2, 5), torch.tensor([False, False]))
    assert matched(shown, none) == [0, 0]
    assert matched(None, none) == [0, 0]  # the first of equal places


# Policies


@pytest.mark.usefixtures("short_fit")
def test_a_policy_with_it_trains_and_is_the_same_when_it_is_loaded(dataset, tmp_path):
    data = {"demo_repo_id": "test/table", "demo_root": str(dataset.root)}
    policy, _, _ = small_policy(dataset, **MATCHING, **data)
    batch = batch_of(dataset, [0, 30])
    loss, _ = policy(batch)
    assert policy.goals.matching.fitted
    loss.backward()
    assert all(weights.grad is None for weights in policy.goals.matching.parameters())
    assert not any("matching" in name for name, weights in policy.named_parameters() if weights.requires_grad)
    policy.eval().save_pretrained(tmp_path)
    loaded = DeltacoPolicy.from_pretrained(tmp_path)
    seen = observation(dataset, TASKS)
    for each in (policy, loaded):
        each.reset()
    found, again = (each.encode_task(tuple(TASKS), each.scenes(seen)).goals for each in (policy, loaded))
    assert torch.equal(found.places, again.places)
    assert torch.equal(found.logits, again.logits)


@pytest.mark.usefixtures("short_fit")
@pytest.mark.parametrize("size", [16, 17, 18, 19])
def test_any_size_of_images_will_do(dataset, size):
    data = {"demo_repo_id": "test/table", "demo_root": str(dataset.root), "image_size": size}
    policy, _, _ = small_policy(dataset, **{**MATCHING, **data})
    policy(batch_of(dataset, [0]))
    policy.eval()
    goals = policy.encode_task(tuple(TASKS), policy.scenes(observation(dataset, TASKS))).goals
    assert goals.places.isfinite().all()
    assert goals.places.abs().max() <= 1


@pytest.mark.usefixtures("short_fit")
def test_several_demonstrations_and_methods_will_do(dataset):
    data = {"demo_repo_id": "test/table", "demo_root": str(dataset.root)}
    for options in ({"n_demonstrations": 3}, {"method": "demo_only"}):
        policy, _, _ = small_policy(dataset, **MATCHING, **data, **options)
        policy(batch_of(dataset, [0]))
        assert bool(policy.config.known_words) == ("method" not in options)
        policy.eval()
        goals = policy.encode_task(tuple(TASKS), policy.scenes(observation(dataset, TASKS))).goals
        assert goals.places.isfinite().all()


@pytest.mark.usefixtures("short_fit")
def test_all_other_weights_are_the_same_without_it(dataset):
    losses, weights = [], []
    for options in (WITHOUT, MATCHING):
        torch.manual_seed(0)
        policy, _, _ = small_policy(dataset, **options)
        losses.append(policy(batch_of(dataset, [0, 30]))[0])
        weights.append({name: value for name, value in policy.state_dict().items() if "matching" not in name})
    assert torch.equal(*losses)
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


@pytest.mark.usefixtures("short_fit")
def test_a_fitted_one_is_not_fitted_again(dataset, tmp_path):
    policy, _, _ = small_policy(dataset, **MATCHING)
    policy(batch_of(dataset, [0]))
    policy.save_pretrained(tmp_path)
    before = copy.deepcopy(policy.goals.matching.state_dict())
    resumed = DeltacoPolicy.from_pretrained(tmp_path, dataset_meta=dataset.meta).train()
    resumed.config.seed = 5
    resumed(batch_of(dataset, [0]))
    assert all(
        torch.equal(before[name], value) for name, value in resumed.goals.matching.state_dict().items()
    )


def test_it_decides_between_things_that_the_locator_confuses(dataset, episodes, published, examples):
    policy, _, _ = small_policy(dataset, **MATCHING, demo_repo_id="test/table", demo_root=str(dataset.root))
    matching = new_matching(published, n_words=len(policy.config.known_words))
    fit_matching(matching, *examples, None, seed=0, steps=60)
    policy.goals.matching.load_state_dict(matching.state_dict())
    with torch.no_grad():
        policy(batch_of(dataset, [0]))  # fits the states at goals
    policy.eval()
    right = 0
    for number in range(10):
        policy.reset()
        seen = {
            key: value[None] for key, value in dataset[7 * number].items() if key.startswith("observation.")
        }
        task = episodes[number][0]
        goals = policy.encode_task((task,), policy.scenes(seen)).goals
        right += bool((goals.places[0, 0] - torch.tensor(episodes[number][1])).abs().max() < 0.2)
    assert right >= 9  # the locator is untrained, so it alone would be right by chance


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"demo_encoder": "attention"}, "is for `demo_encoder=correspondence`"),
        ({"method": "language_only"}, "The method 'language_only' gets none"),
        ({"method": "one_hot"}, "The method 'one_hot' gets none"),
    ],
)
def test_where_there_is_nothing_to_match_it_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        DeltacoConfig(device="cpu", backbone="strided", **{**MATCHING, **options})


# The command


@pytest.fixture
def checkpoint(dataset, tmp_path):
    policy, before, after = small_policy(
        dataset, **WITHOUT, demo_repo_id="test/table", demo_root=str(dataset.root)
    )
    policy(batch_of(dataset, [0]))
    folder = tmp_path / "checkpoint"
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    (folder / "README.md").write_text("Figures of the old policy.\n")
    return folder


@pytest.mark.usefixtures("short_fit")
def test_the_command_adds_it_to_a_trained_policy(checkpoint, dataset, tmp_path, capsys):
    out = tmp_path / "matched"
    match.main([str(checkpoint), "--dataset.root", str(dataset.root), "--out", str(out)])
    assert "fitted to 60 episodes" in capsys.readouterr().out
    old, new = DeltacoPolicy.from_pretrained(checkpoint), DeltacoPolicy.from_pretrained(out)
    assert new.config.pretrained_matching
    assert new.goals.matching.fitted
    assert all(torch.equal(value, new.state_dict()[name]) for name, value in old.state_dict().items())
    files = {path.name for path in checkpoint.iterdir()} - {"README.md"}
    assert {path.name for path in out.iterdir()} == files
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.usefixtures("short_fit")
def test_the_command_fits_it_anew_also_that_of_another_version(checkpoint, dataset, tmp_path):
    root = ("--dataset.root", str(dataset.root))
    first, second = tmp_path / "first", tmp_path / "second"
    match.main([str(checkpoint), *root, "--out", str(first)])
    name = "goals.matching.demo.linear.weight"
    weights = load_file(first / "model.safetensors")
    weights["goals.matching.demo.fine.weight"] = weights.pop(name)
    save_file(weights, first / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ValueError, match="was saved by another version. `deltaco-match` fits it anew"):
        DeltacoPolicy.from_pretrained(first)
    match.main([str(first), *root, "--out", str(second), "--seed", "1"])
    new, old = DeltacoPolicy.from_pretrained(second).state_dict(), load_file(checkpoint / "model.safetensors")
    assert all(torch.equal(value, new[key]) for key, value in old.items())
    assert new["goals.matching.fitted"]
    assert not torch.equal(new[name], weights["goals.matching.demo.fine.weight"])


@pytest.mark.usefixtures("short_fit")
@pytest.mark.parametrize(
    ("name", "folder", "n_episodes"),
    [("test/table", None, 30), ("test/other", "same", 30), ("test/other", None, 60)],
)
def test_the_command_leaves_out_what_the_training_held_back(
    checkpoint, dataset, tmp_path, capsys, caplog, name, folder, n_episodes
):
    root = str(dataset.root) if folder else None
    trained_on = {"repo_id": "test/table", "root": root, "episodes": list(range(40)), "eval_split": 0.25}
    (checkpoint / "train_config.json").write_text(json.dumps({"dataset": trained_on}))
    data = ["--dataset.root", str(dataset.root), "--dataset.repo_id", name]
    match.main([str(checkpoint), *data, "--out", str(tmp_path / "matched")])
    assert f"fitted to {n_episodes} episodes" in capsys.readouterr().out
    assert ("was trained on some of the episodes of test/table" in caplog.text) == (n_episodes == 60)


def test_the_command_wants_the_episodes_of_the_training(checkpoint, dataset, tmp_path, capsys):
    trained_on = {"repo_id": "test/table", "episodes": [3, 60]}
    (checkpoint / "train_config.json").write_text(json.dumps({"dataset": trained_on}))
    data = ["--dataset.root", str(dataset.root), "--dataset.repo_id", "test/table"]
    with pytest.raises(SystemExit):
        match.main([str(checkpoint), *data, "--out", str(tmp_path / "matched")])
    assert "episodes up to 60 of test/table, but the dataset has only 60" in capsys.readouterr().err


def with_matching(checkpoint):
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_matching = True
    return config


def test_the_command_says_what_it_cannot_do(checkpoint, dataset, tmp_path, capsys):
    def said(*arguments):
        with pytest.raises(SystemExit) as end:
            match.main([str(argument) for argument in arguments])
        return end.value.code, capsys.readouterr().err

    root = ("--dataset.root", dataset.root)
    code, text = said(checkpoint, *root, "--out", checkpoint)
    assert code == 2
    assert "exists. Name a new folder" in text
    code, text = said(checkpoint, *root, "--out", checkpoint / "new")
    assert code == 1
    assert "Name a folder outside of it" in text
    damaged = tmp_path / "damaged"
    shutil.copytree(checkpoint, damaged)
    (damaged / "model.safetensors").write_bytes(b"no weights")
    code, text = said(damaged, *root, "--out", tmp_path / "new")
    assert code == 1
    assert "damaged" in text
    assert "Traceback" not in text
    shutil.copy(checkpoint / "model.safetensors", damaged)
    config = json.loads((checkpoint / "config.json").read_text())
    (damaged / "config.json").write_text(json.dumps({**config, "flavor": "sweet"}))
    code, text = said(damaged, *root, "--out", tmp_path / "new")
    assert code == 1
    assert f"The configuration of {damaged} is invalid" in text
    assert "flavor" in text
    code, text = said(tmp_path / "nothing", *root, "--out", tmp_path / "new")
    assert code == 1
    assert "is no checkpoint" in text
    with pytest.raises(ValueError, match="`deltaco-match` adds it"):
        DeltacoPolicy.from_pretrained(checkpoint, config=with_matching(checkpoint))
    shutil.rmtree(checkpoint)
    policy, _, _ = small_policy(dataset, image_size=SIZE, demo_encoder="attention")
    policy.save_pretrained(checkpoint)
    code, text = said(checkpoint, *root, "--out", tmp_path / "new")
    assert code == 1
    assert "for policies with demo_encoder=correspondence" in text
    assert not (tmp_path / "new").exists()
