"""What `deltaco_match` consists of: heights, places, feature matching."""

import copy
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_policies import random_moves

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.base.augmentation import change_colors, random_color_changes
from lerobot_deltaco.policies.base.configuration import has_bfloat16
from lerobot_deltaco.policies.base.image_coordinates import gaussian_maps
from lerobot_deltaco.policies.deltaco_match import fit
from lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match import MatchingSettings
from lerobot_deltaco.policies.deltaco_match.feature_matching import (
    Candidates,
    FeatureMatching,
    GraspHeightEstimator,
)
from lerobot_deltaco.policies.deltaco_match.fit import fit_feature_matching, fit_matching_head
from lerobot_deltaco.policies.deltaco_match.localization import (
    TARGET_DIM,
    Localizer,
    PlaceNetwork,
    peak_locations,
)
from lerobot_deltaco.policies.deltaco_match.words import encode_words, understand, vocabulary_of
from lerobot_deltaco.policies.scene.crops import CropEncoder, cut_crops
from lerobot_deltaco.policies.scene.proposals import N_OBJECTS, Background


def test_height_of_a_demonstration_counts_as_far_as_it_can_be_trusted():
    torch.manual_seed(0)
    n, dim = 256, 8
    estimator = GraspHeightEstimator(dim)
    optimizer = torch.optim.Adam(estimator.parameters(), lr=1e-2)

    def samples():
        is_same = torch.arange(n) % 2 == 0
        heights = torch.randn(n)
        demonstrated = torch.where(is_same, heights, torch.randn(n))
        return torch.randn(n, dim), torch.where(is_same, 0.9, 0.2), demonstrated, heights

    for _ in range(150):
        loss = estimator.losses(*samples()).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    features, similarity, demonstrated, heights = samples()
    found, is_same = estimator(features, similarity, demonstrated), similarity > 0.5
    assert (found - heights)[is_same].abs().mean() < 0.1
    # Another object's height counts little, and an unknown one not at all.
    by_appearance = estimator(features, similarity, demonstrated * torch.nan)
    assert by_appearance.isfinite().all()
    change = (found - by_appearance)[~is_same].abs().mean()
    assert change < 0.5 * (demonstrated - by_appearance)[~is_same].abs().mean()


def test_a_demonstrated_height_counts_where_it_is_far_from_those_of_the_training():
    """Objects of one height in the training say nothing of a taller one, if demonstrations are exact."""
    estimator = GraspHeightEstimator(4)
    with torch.no_grad():
        for layer in (estimator.by_appearance, estimator.demonstration_error[2]):
            layer.weight.zero_()
            layer.bias.zero_()
    std = float(estimator._log_std(torch.zeros(1)).exp())
    assert std < 0.5
    shown = torch.tensor([0.2, 4.0])
    usual, tall = estimator(torch.zeros(2, 4), torch.zeros(2), shown).tolist()
    assert usual == pytest.approx(0.2 * 0.7**2 / (0.7**2 + std**2))
    assert tall == pytest.approx(4, abs=0.1)


def test_color_jitter_changes_a_fraction_of_the_samples_and_leaves_gray_gray():
    changes = random_color_changes(400, 0.7, torch.Generator().manual_seed(0))
    same = (changes == torch.eye(3)).all(dim=(1, 2))
    assert 0.2 < same.float().mean() < 0.4
    gray = change_colors(torch.full((400, 3, 2, 2), 0.4), changes)
    torch.testing.assert_close(gray, gray[:, :1].expand_as(gray))
    images = torch.rand(400, 2, 3, 4, 4)
    changed = change_colors(images, changes)
    assert changed.shape == images.shape
    assert ((changed >= 0) & (changed <= 1)).all()
    torch.testing.assert_close(changed[same], images[same])
    # All images of a sample change alike.
    torch.testing.assert_close(change_colors(images[:, 0], changes), changed[:, 0])


def test_peak_of_a_map_is_its_location():
    locations = torch.rand(5, 2, 2, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8
    maps = gaussian_maps(locations, 24, 32, 0.1)
    torch.testing.assert_close(peak_locations(20 * maps), locations, atol=0.03, rtol=0)
    found, logits = torch.tensor([[[-0.5, 0.2], [0.6, -0.4]]]), torch.tensor([[0.2, 0.8]]).log()
    candidates = Candidates(found, logits, torch.zeros(1, 2), 0.1)
    maps = candidates.map((24, 30), MatchingSettings.map_std)
    assert maps.shape == (1, 24, 30)
    torch.testing.assert_close(peak_locations(maps[:, None])[0, 0], candidates.best[0][0], atol=0.05, rtol=0)


def test_parts_of_an_object_are_as_sure_together_as_the_object():
    locations = torch.tensor([[[-0.5, 0.2], [-0.45, 0.2], [0.6, -0.4]]])
    candidates = Candidates(locations, torch.tensor([[0.5, 0.3, 0.2]]).log(), torch.zeros(1, 3), radius=0.1)
    location, probability, _ = candidates.best
    assert location.tolist() == [[-0.5, pytest.approx(0.2)]]
    assert probability.item() == pytest.approx(0.8)


def test_the_demonstration_or_the_instruction_says_where():
    torch.manual_seed(0)
    network = PlaceNetwork(5).eval()
    scenes, last = torch.rand(2, 3, 16, 16), torch.rand(2, 3, 16, 16)
    attention = torch.rand(2, 8, 8).flatten(1).softmax(dim=1).view(2, 8, 8)
    target, nothing = network.target(last, attention), torch.zeros(2, TARGET_DIM)
    assert target.shape == nothing.shape
    instruction = torch.randn(2, 5)
    inputs = [(words, to) for words in (instruction, 0 * instruction) for to in (target, nothing)]
    with torch.no_grad():
        maps = [network(scenes, *each) for each in inputs]
    assert maps[0].shape == (2, 8, 8)
    assert len({float(each.sum()) for each in maps}) == 4


# Feature matching

SIZE = 48
SHAPE_TASKS = ["move the ring left", "move the cross right"]


def draw_shapes(task, moved, other):
    """Draws a ring and a cross of 9 x 9 px and one color on a gray table, the task's first."""
    image = np.full((SIZE, SIZE, 3), 150, np.uint8)
    y, x = np.mgrid[-4:5, -4:5]
    ring, cross = (np.hypot(x, y) < 4.6) & (np.hypot(x, y) > 2.2), (abs(x) < 1.5) | (abs(y) < 1.5)
    masks = (ring, cross) if "ring" in task else (cross, ring)
    for mask, location in zip(masks, (moved, other), strict=True):
        column, row = (round((c + 1) * SIZE / 2) for c in location)
        image[row - 4 : row + 5, column - 4 : column + 5][mask] = (60, 90, 160)
    return image


@pytest.fixture(scope="module")
def shapes():
    """First images, locations of the grasps, and tasks of episodes."""
    moves = random_moves(36, SHAPE_TASKS)
    images = np.stack([draw_shapes(*move[:3]) for move in moves])
    images = torch.from_numpy(images).permute(0, 3, 1, 2).contiguous()
    locations = torch.tensor(np.stack([move[1] for move in moves]), dtype=torch.float32)
    return images, locations, [move[0] for move in moves]


NEEDS_BFLOAT16 = pytest.mark.skipif(not has_bfloat16(), reason="emulated bfloat16 takes minutes")


@pytest.fixture(
    scope="module",
    params=[pytest.param(False, id="float32"), pytest.param(True, id="bfloat16", marks=NEEDS_BFLOAT16)],
)
def matching(shapes, request):
    """A feature matching that is fitted to 24 of the episodes."""
    images, locations, tasks = (part[:24] for part in shapes)
    short = MatchingSettings(
        refinement_steps=30,
        min_matching_steps=60,
        matching_batch=32,
        max_variants=2,
    )
    matching = FeatureMatching(vocabulary_of(SHAPE_TASKS), short)
    sentences, heights = {task: [task] for task in tasks}, torch.zeros(24)
    # As in the first step of a policy's training.
    with torch.autocast("cpu", torch.bfloat16), torch.autocast("cpu", enabled=False):
        fit_feature_matching(
            matching,
            *(images, images, images, locations, heights, tasks, sentences),
            seed=0,
            in_bfloat16=request.param,
        )
    assert matching.fitted
    return matching


@pytest.fixture(scope="module", autouse=True)
def encode_once():
    """Encodes the same crops once."""
    features, encode = {}, CropEncoder.__call__

    def encode_once(self, *crops):
        key = tuple(part.numpy().tobytes() for part in crops)
        if key not in features:
            features[key] = encode(self, *crops)
        return features[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CropEncoder, "__call__", encode_once)
        yield


def both_ends(images):
    """First and last images of episodes that end as they begin."""
    return torch.stack([images, images], dim=1)


def fraction_found(matching, shapes, by_demonstration=False, words=lambda task: "", grasp=None, further=2):
    """Fraction of the other 12 episodes in which the object is found, by other episodes or by words.

    Tasks alternate: an odd number of episodes further, the demonstration shows the other object.
    With `grasp`, the gripper closes there, and only the attention tells where the object was.
    """
    images, locations, tasks = (part[24:] for part in shapes)
    scenes = images.float() / 255
    shown = [(n + further) % 12 for n in range(12)]
    described = demonstrated = None
    if by_demonstration:
        attended = locations[shown]
        grasps = attended if grasp is None else torch.full_like(attended, grasp)
        described = matching.describe(both_ends(scenes[shown]), scenes[shown], grasps, attended).descriptors
        demonstrated = torch.zeros(12)
    candidates = matching.find(scenes, [*map(words, tasks)], described, demonstrated)
    assert candidates.locations.shape == (12, N_OBJECTS, 2)
    # The object may be none of the candidates.
    p_any, p_none = candidates.log_probabilities.exp().sum(dim=1), float(matching.error_rate)
    assert (p_any <= 1 + 1e-5).all()
    assert (p_any >= 1 - p_none - 1e-5).all()
    return ((candidates.best[0] - locations).abs().amax(dim=1) < 0.2).float().mean()


def test_fit_finds_shapes_of_one_color_by_demonstrations_and_by_words(matching, shapes):
    assert fraction_found(matching, shapes, by_demonstration=True) >= 0.9
    assert fraction_found(matching, shapes, words=lambda task: task) >= 0.9
    assert fraction_found(matching, shapes, words=lambda task: "RING!" if "ring" in task else "cros") > 0.7
    # Unknown words leave the demonstration in charge, and known ones still count.
    assert fraction_found(matching, shapes, True, lambda task: "the gizmo") >= 0.9
    assert fraction_found(matching, shapes, words=lambda task: "a b c") < 0.8
    # An object that was pushed before its grasp is found where it was.
    for grasp in (2.0, torch.nan):
        assert fraction_found(matching, shapes, True, grasp=grasp) >= 0.9


def test_words_decide_in_conflict_after_many_episodes(matching, shapes):
    other = dict(zip(SHAPE_TASKS, SHAPE_TASKS[::-1], strict=True))
    assert fraction_found(matching, shapes, words=other.get) <= 0.2
    # After few, a clear demonstration does.
    assert fraction_found(matching, shapes, True, other.get) >= 0.8
    many = copy.deepcopy(matching)
    many.n_episodes.fill_(10_000)
    assert fraction_found(many, shapes, True, other.get) <= 0.2
    assert fraction_found(many, shapes, True, lambda task: task, further=3) >= 0.8
    # Words that name nothing do not.
    assert fraction_found(many, shapes, True, lambda task: "the gizmo", further=3) < 0.2


def test_places_are_found_where_they_stand_now_and_where_nothing_moves(matching, shapes):
    images, locations, _ = (part[24:] for part in shapes)
    shown = [(n + 2) % 12 for n in range(12)]
    unknown, beside = torch.full_like(locations, torch.nan), torch.tensor([0.05, -0.08])
    (found,) = matching.find_places(images, images[shown], unknown, locations[shown] + beside, [1.0])
    assert ((found - locations - beside).norm(dim=1) < 0.15).float().mean() >= 0.9
    # The object that is grasped is not the place, however near it stands.
    (found,) = matching.find_places(images, images[shown], locations[shown], locations[shown] + beside, [1.0])
    assert not ((found - locations - beside).norm(dim=1) < 0.15).float().mean() >= 0.5
    # The edges of the table are empty in all episodes.
    corner = torch.full_like(locations, 0.95)
    assert torch.equal(matching.find_places(images, images[shown], unknown, corner, [1.0])[0], corner)


@pytest.mark.parametrize(
    ("kind", "n_episodes", "expected"), [("objects", 24, 1), ("random", 24, 0), ("objects", 999, 0)]
)
def test_demonstrations_say_where_to_place_if_that_is_right(matching, shapes, kind, n_episodes, expected):
    images, locations, tasks = (part[:24] for part in shapes)
    localizer = Localizer(matching.vocabulary)
    localizer.matching.load_state_dict(matching.state_dict())
    localizer.matching.n_episodes.fill_(n_episodes)
    places = locations if kind == "objects" else locations.roll(1, 0) * torch.tensor([-1.0, 1.0])
    picks = torch.full_like(locations, torch.nan)
    localizer.measure_places(images, torch.stack([picks, places], dim=1), tasks)
    assert localizer.demonstrates_places == expected
    assert not expected or localizer.place_reach > 0


def test_certainty_is_limited_by_the_number_of_held_out_episodes(matching, shapes):
    n_right, n_all = matching.held_out.tolist()
    assert n_all == 4
    assert matching.report.endswith(f"object found in {n_right} of 4 held-out episodes")
    scenes = shapes[0][24:].float() / 255
    candidates = matching.find(scenes, [*shapes[2][24:]], None, None)
    n_objects = candidates.locations.shape[1]
    limit = 1 - float(matching.error_rate) * (1 - 1 / n_objects)
    assert candidates.log_probabilities.exp().max() <= limit + 1e-5
    assert limit < 0.92  # Jeffreys' prior: 1 - 0.5 / 5, and some of the rest


def test_objects_are_new_by_an_unknown_noun_or_without_words_after_few_episodes(matching, monkeypatch):
    known, unknown, nothing = matching.novelty(["move the ring left", "move the gizmo left", ""]).tolist()
    assert known < 0.1 < 0.5 < unknown
    assert matching.n_episodes == 24
    assert nothing == 1
    monkeypatch.setattr(matching, "settings", replace(matching.settings, few_episodes=23))
    assert matching.novelty([""]).tolist() == [0]


def test_after_many_episodes_only_new_objects_are_grasped_as_in_the_demonstration(matching, shapes):
    scenes, proposals = shapes[0][24:28].float() / 255, shapes[1][24:28]
    templates = torch.rand(4, 1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
    given, as_usual = (scenes, proposals, templates), matching.grasps(scenes, proposals)
    novelty, many = torch.tensor([0.0, 0.3, 0.7, 1.0]), copy.deepcopy(matching)
    many.n_episodes.fill_(10_000)
    found = many.grasps(*given, novelty)
    assert torch.equal(found[:2], as_usual[:2])
    assert (found[2:] != as_usual[2:]).any(dim=1).all()
    assert (matching.grasps(*given, novelty) != as_usual).any(dim=1).all()  # after few, all are


def test_what_disappeared_is_the_demonstrated_object_also_beside_others(matching, shapes):
    first = shapes[0][:1].float() / 255
    last = first.clone()
    (column, row), grasp = ((shapes[1][0] + 1) * SIZE / 2).round().long(), shapes[1][:1]
    # Something as large touches it, and stays.
    table = first[0, :, 0, 0, None, None]
    first[0, :, row - 4 : row + 5, column + 5 : column + 14] = torch.tensor([0.3, 0.4, 0.6])[:, None, None]
    last[0, :, row - 4 : row + 5, column + 5 : column + 14] = torch.tensor([0.3, 0.4, 0.6])[:, None, None]
    last[0, :, row - 4 : row + 5, column - 4 : column + 5] = table
    center, is_near = matching.demonstrated(torch.stack([first, last], dim=1), first, grasp, grasp)
    assert is_near.all()
    assert (center - grasp).norm() * SIZE / 2 < 1  # px


def test_fit_is_a_function_of_its_seed_and_trains_nothing_but_itself(shapes, short_fit):
    images, locations, tasks = (part[:8] for part in shapes)
    state = torch.get_rng_state()
    fitted = []
    for seed in (0, 0, 1):
        matching = FeatureMatching(vocabulary_of(tasks)).train()
        torch.set_rng_state(state)
        sentences = {task: [task] for task in tasks}
        fit_feature_matching(
            matching, images, images, images, locations, torch.zeros(8), tasks, sentences, seed
        )
        assert torch.equal(torch.get_rng_state(), state)
        assert not any(weights.requires_grad for weights in matching.parameters())
        assert not any(module.training for module in matching.modules())
        fitted.append(dict(matching.state_dict()))
    assert all(torch.equal(fitted[0][name], fitted[1][name]) for name in fitted[0])
    assert not torch.equal(fitted[0]["compare.hidden.weight"], fitted[2]["compare.hidden.weight"])


@pytest.mark.parametrize(("n_scenes", "steps"), [(8, 2), (40, 9)])
def test_steps_of_the_fit_follow_the_number_of_scenes(n_scenes, steps, monkeypatch, short_fit):
    draws, draw = [], fit.EpisodePairs.draw
    monkeypatch.setattr(fit.EpisodePairs, "draw", lambda *own: draws.append(1) or draw(*own))
    settings = MatchingSettings(
        grasp_error=9.0, refinement_steps=2, min_matching_steps=2, max_matching_steps=9
    )
    matching = FeatureMatching(["task"], settings)
    images = torch.zeros(n_scenes, 3, 16, 16, dtype=torch.uint8)
    tasks, sentences = ["task"] * n_scenes, {"task": ["task"]}
    fit_feature_matching(
        matching, *[images] * 3, torch.zeros(n_scenes, 2), torch.zeros(n_scenes), tasks, sentences, 0
    )
    assert len(draws) == 1 + steps  # the first, for the scales


def test_a_camera_that_moved_during_the_recording_is_told(shapes, short_fit, caplog):
    images, locations, tasks = shapes
    sentences = {task: [task] for task in tasks}
    generator = torch.Generator().manual_seed(0)
    ground = torch.randint(0, 255, (3, 8, 8), generator=generator).float()
    ground = torch.nn.functional.interpolate(ground[None], (SIZE, SIZE))[0].to(torch.uint8)
    settings = MatchingSettings(min_matching_steps=2, max_matching_steps=2, refinement_steps=2)
    is_object = (images != 150).any(dim=1, keepdim=True)
    for moves in (False, True):
        shifts = torch.randint(-9, 10, (len(images), 2), generator=generator) * moves
        grounds = torch.stack([ground.roll(shift.tolist(), dims=(1, 2)) for shift in shifts])
        recorded = torch.where(is_object, images, grounds)
        data = (*[recorded] * 3, locations, torch.zeros(len(images)), tasks, sentences, 0)
        with pytest.raises(UserError, match="the first camera stands still") if moves else nullcontext():
            fit_feature_matching(FeatureMatching(vocabulary_of(tasks), settings), *data)
        assert ("Only 0 % of the grasped objects stand out" in caplog.text) == moves


def test_words_that_describe_the_container_do_not_count():
    """The color of an object and that of its container vary independently. A proposal is background."""
    tasks = [f"put the {color} cube in the {bin} bin" for color in ("red", "blue") for bin in ("red", "blue")]
    generator = torch.Generator().manual_seed(0)
    matching = FeatureMatching(vocabulary_of(tasks), MatchingSettings(matching_batch=16))
    # Crops in which only the color can be seen, of two objects, and of the background.
    n_scenes = 256
    task = torch.arange(n_scenes) % 4
    target = torch.randint(2, (n_scenes,), generator=generator)
    color = torch.where(torch.arange(2) == target[:, None], task[:, None] // 2, 1 - task[:, None] // 2)
    features = torch.randn(n_scenes, 3, matching.encoder.feature_dim, generator=generator)
    features[:, :2, :100] += 4.0 * color[..., None]
    features[:, 2, 100:200] += 4.0
    matching.requires_grad_(True)
    distances = 2.0 * (torch.arange(2) != target[:, None])
    sentences = {text: [text] for text in tasks}
    drawn = [tasks[n] for n in task]
    autocast = torch.autocast("cpu", enabled=False)
    fit_matching_head(
        *(matching, features[None], distances, torch.zeros(n_scenes)),
        *(drawn, sentences, generator, 150, autocast),
    )
    sentence = "Putt the red cubee in the red bin"
    weights = matching.word_weights(encode_words([sentence], matching.vocabulary))[0]
    assert weights[2] > 0.7
    assert weights[[0, 1, 4, 5, 6, 7]].max() < 0.3, weights
    assert ("red", "red") in matching.understood(sentence)
    assert len(matching.understood(sentence)) < 4
    assert matching.understood("") == []


def test_held_out_episodes_without_another_of_their_task_say_that_nothing_is_known():
    generator = torch.Generator().manual_seed(0)
    matching = FeatureMatching(["a", "b"])
    matching.held_out[1] = 1
    matching.requires_grad_(True)
    fit_matching_head(
        matching,
        torch.randn(1, 3, 4, matching.encoder.feature_dim, generator=generator),
        torch.tensor([[0.0, 2, 2]] * 3),
        torch.zeros(3),
        ["a", "b", "b"],
        {"a": ["a"], "b": ["b"]},
        generator,
        2,
        torch.autocast("cpu", enabled=False),
        held_out=torch.tensor([True, False, False]),
    )
    assert matching.held_out.tolist() == [0, 1]
    assert matching.error_rate == 0.75  # Jeffreys' prior


def test_fit_needs_a_task_with_two_grasps(shapes):
    images, locations, tasks = (part[:6] for part in shapes)
    locations = torch.where(torch.arange(6)[:, None] < 2, locations, torch.nan)
    with pytest.raises(ValueError, match="at least two episodes .* 2 such episodes are of 2 different tasks"):
        fit_feature_matching(
            FeatureMatching([]), images, images, images, locations, torch.zeros(6), tasks, {}, 0
        )
    with pytest.raises(ValueError, match="The 2 such episodes are of 2 different tasks"):
        fit.EpisodePairs(["a", "a", "b", "b"], [0, 2])  # the others are held out


def draw_objects(side, locations, shape=(96, 96), seed=0):
    """Draws squares of a side, px, and at locations (n, 2) on a noisy table with a rim."""
    rng = np.random.default_rng((seed, side))
    height, width = shape
    image = np.full((height, width, 3), 140.0)
    image[:4] = image[-4:] = 60
    for (x, y), color in zip(locations, [(200, 60, 50), (90, 90, 90), (60, 80, 190)], strict=False):
        column, row = round((x + 1) * width / 2 - side / 2), round((y + 1) * height / 2 - side / 2)
        image[row : row + side, column : column + side] = color
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def random_places(rng, n=3, distance=0.65):
    """Returns locations in -0.65..0.65 that are apart, (n, 2)."""
    while True:
        places = rng.uniform(-0.65, 0.65, (n, 2))
        if min(np.hypot(*(places[a] - places[b])) for a in range(n) for b in range(a)) > distance:
            return places


def nearest_distances(proposed, locations):
    """Distances of locations (scenes, objects, 2) from the nearest proposals, (scenes, objects)."""
    distances = (proposed[:, :, None] - locations[:, None]).norm(dim=3)
    return distances.nan_to_num(nan=torch.inf).amin(dim=1)


@pytest.mark.parametrize("side", [4, 8, 16, 24])
def test_objects_of_any_size_stand_out_whether_they_were_grasped_or_not(side):
    """Only the first object is ever grasped, and the last is new."""
    rng = np.random.default_rng(side)
    places = np.stack([random_places(rng, distance=0.7 if side > 20 else 0.5) for _ in range(44)])
    drawn = [draw_objects(side, own[: 2 if n < 24 else 3], seed=n) for n, own in enumerate(places)]
    images = torch.tensor(np.stack(drawn)).permute(0, 3, 1, 2)
    background, locations = Background(), torch.tensor(places, dtype=torch.float32)
    background.fit(images[:24], locations[:24, 0])
    assert float(background.object_size) == pytest.approx(side / 96, rel=0.35, abs=0.015)
    proposed = background(images[24:])
    distances = nearest_distances(proposed, locations[24:])
    assert (distances < 0.6 * side / 96).float().mean() > 0.9
    # A training scene is not compared with itself.
    masks = background.masks(images[:24], torch.arange(24))
    distances = nearest_distances(background.objects(masks, images[:24]), locations[:24, :2])
    assert (distances < 0.6 * side / 96).float().mean() > 0.85


def test_objects_of_many_colors_in_other_scenes_hide_none():
    """In a quarter of the scenes, something with all colors stands where an object stands now."""
    generator = torch.Generator().manual_seed(0)
    images = torch.full((48, 3, 128, 128), 120, dtype=torch.uint8)
    for image in images[::4]:
        image[:, 40:70, 50:80] = torch.randint(0, 256, (3, 30, 30), generator=generator)
    background = Background()
    background.fit(images, torch.zeros(48, 2))
    scene = torch.full((1, 3, 128, 128), 120, dtype=torch.uint8)
    scene[0, :, 48:62, 58:72] = torch.tensor([90, 140, 60], dtype=torch.uint8)[:, None, None]
    mask = background.masks(scene)[0] > 0.5
    assert mask[48:62, 58:72].float().mean() > 0.95
    assert mask.sum() < 1.1 * 14**2


def test_crops_are_centered_and_see_the_native_resolution():
    images = torch.zeros(1, 3, 90, 120, dtype=torch.uint8)
    images[0, :, 60:64, 30:34] = 255
    locations = torch.tensor([[[-0.4667, 0.3778], [0.9, -0.9]]])
    crops = cut_crops(images, locations, torch.full((1, 2), 0.2), resolution=24)
    assert crops.shape == (1, 2, 3, 24, 24)
    assert (crops[0, 0, 0] > 0.5).nonzero().float().mean(dim=0).tolist() == pytest.approx([11.5] * 2, abs=0.6)
    assert not crops[0, 1].any()


def test_crops_show_what_the_policys_small_images_do_not(matching):
    """At 192 px, objects with fine stripes are others than plain ones; at 48 px, they are equal."""
    plain = torch.full((1, 3, 192, 192), 0.5)
    plain[:, :, 80:112, 80:112] = 0.3
    striped = plain.clone()
    striped[:, :, 80:112, 80:112:4] = striped[:, :, 80:112, 81:112:4] = 0.1
    striped[:, :, 80:112, 82:112:4] = striped[:, :, 80:112, 83:112:4] = 0.5
    small = [
        torch.nn.functional.interpolate(images, (SIZE, SIZE), mode="area") for images in (plain, striped)
    ]
    torch.testing.assert_close(*small)
    at = torch.zeros(1, 2)
    plain, striped, blurred = (
        matching.describe(both_ends(small[0]), images, at, at).descriptors
        for images in (plain, striped, small[1])
    )
    similar, different = ((plain * other).sum() / plain.square().sum() for other in (blurred, striped))
    assert different < 0.6 < similar


def test_words_are_understood():
    vocabulary = vocabulary_of(["Put the red cup in.", "Put 2 yellow bowls in."])
    assert vocabulary == ["2", "bowls", "cup", "in", "put", "red", "the", "yellow"]
    understood = understand("put RED yelow bowls, inn the jar 2!", vocabulary)
    assert understood == ["put", "red", "yellow", "bowls", None, "the", None, "2"]
    assert encode_words(["the cup", "", "x"], vocabulary).tolist() == [[8, 4], [0, 0], [1, 0]]
    assert encode_words(["", "?!"], vocabulary).tolist() == [[0], [0]]
    # Equal text has equal words, and marks stay with their letters.
    assert vocabulary_of(["Cafe\u0301 हिन्दी"]) == vocabulary_of(["café हिन्दी"]) == ["café", "हिन्दी"]
    # Languages without spaces have a word for each character.
    vocabulary = vocabulary_of(["把红色的杯子放进左边的盒子", "赤いカップを左の箱に"])
    assert understand("红色的箱 cup", vocabulary) == ["红", "色", "的", "箱", None]
