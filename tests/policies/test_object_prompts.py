"""A point, a box or a photo of an object, in place of a demonstration."""

import numpy as np
import pytest
import torch
from PIL import Image
from small_policies import (
    TABLE_LENGTH,
    TABLE_SIZE,
    TABLE_TASKS,
    batch_of,
    random_moves,
    small_policy,
)

from lerobot_deltaco.data.object_prompts import ObjectPrompt, read_prompt
from lerobot_deltaco.errors import UserError
from lerobot_deltaco.policies.deltaco_match.feature_matching import Candidates
from lerobot_deltaco.policies.deltaco_match.modeling_deltaco_match import DeltacoMatchPolicy
from lerobot_deltaco.policies.deltaco_match.prompts import choose_prompted, cut_box

MOVES = random_moves(48)  # of `table`
PIXEL = 2 / TABLE_SIZE

pytestmark = pytest.mark.usefixtures("short_fit")


@pytest.fixture(scope="module")
def trained(table):
    """A policy, and its preprocessor."""
    from small_policies import use_fake_encoder, use_short_fit

    with pytest.MonkeyPatch.context() as patch:
        use_fake_encoder(patch)
        use_short_fit(patch)
        policy, before, _ = small_policy(table, "deltaco_match")
    return policy.eval(), before


def first_images(table, before, episodes):
    batch = batch_of(table, [TABLE_LENGTH * episode for episode in episodes])
    seen = {name: value for name, value in batch.items() if name.startswith("observation.")}
    return before({**seen, "task": [MOVES[episode][0] for episode in episodes]})


def point_at(location, image=None):
    x, y = ((coordinate + 1) / 2 for coordinate in location)
    return ObjectPrompt((x, y, x, y), image)


def test_what_is_pointed_at_is_picked_whatever_the_sentence(table, trained):
    policy, before = trained
    episodes = range(0, 48, 6)
    for which in (1, 2):  # the object that the task moves, and the other one
        points = [MOVES[episode][which] for episode in episodes]
        for task in TABLE_TASKS:
            policy.reset()
            prompts = [[point_at(point)] for point in points]
            policy.set_tasks([task] * len(points), prompts)
            policy.select_action(first_images(table, before, episodes))
            found = policy.localization
            distances = (found.locations[:, 0].numpy() - np.array(points)) / PIXEL
            assert np.abs(distances).max() < 3.5
            assert (found.confidence == 1).all()
            assert not any(found.by_demonstration)


def test_a_point_in_the_middle_of_the_picture_picks_an_object_and_not_the_middle(trained):
    """Where there is no proposal, there is none in the middle either."""
    candidates = Candidates(
        torch.tensor([[[0.1, 0.1], [torch.nan, torch.nan]]]),
        torch.tensor([[0.0, -torch.inf]]),
        torch.tensor([[2.0, 0.0]]),
        radius=0.2,
    )
    chosen = choose_prompted(candidates, [point_at((0.06, 0.02))])
    location, probability, height = chosen.best
    torch.testing.assert_close(location, torch.tensor([[0.1, 0.1]]))
    assert (probability, height) == (1, 2)
    assert chosen.map((4, 4), 1.0).isfinite().all()


def test_an_episode_of_the_training_is_replayed(table, trained, tmp_path):
    policy, before = trained
    policy.save_pretrained(tmp_path)
    loaded = DeltacoMatchPolicy.from_pretrained(tmp_path)
    assert loaded.replay.n_trajectories == policy.replay.n_trajectories > 20
    actions = []
    for each in (policy, loaded):
        each.reset()
        each.set_tasks([TABLE_TASKS[0]], [[point_at(MOVES[0][1])]])
        actions.append(each.select_action(first_images(table, before, [0])))
        assert each._episode.replayed.all()
    assert torch.equal(*actions)
    # Alike for a sentence without a demonstration.
    loaded.reset()
    loaded.set_tasks([TABLE_TASKS[0]], [[]])
    loaded.select_action(first_images(table, before, [0]))
    assert loaded._episode.replayed.all()


def test_a_photo_has_the_descriptor_of_the_object_in_it(table, trained):
    policy, before = trained
    matching = policy.localizer.matching
    photo = (255 * table[0]["observation.image"]).round().byte()
    other = first_images(table, before, [7])
    seen = []

    def find(*arguments):
        seen.append(arguments[2])
        return type(matching).find(matching, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching, "find", find)
        # Both the point and the box of the red object, in another picture, and that picture's own point
        middle = ((MOVES[0][1] + 1) / 2 * TABLE_SIZE).round()  # px, of a square of 4 x 4
        box = tuple(np.concatenate([middle - 2.5, middle + 2.5]) / TABLE_SIZE)
        for prompt in (point_at(MOVES[0][1], photo), ObjectPrompt(box, photo), point_at(MOVES[0][2], photo)):
            policy.reset()
            policy.set_tasks([TABLE_TASKS[0]], [[prompt]])
            policy.select_action(other)
        policy.reset()
        policy.set_tasks([TABLE_TASKS[0]], [[point_at(MOVES[0][1])]])
        policy.select_action(first_images(table, before, [0]))
    by_point, by_box, of_other, in_scene = seen
    torch.testing.assert_close(by_point, in_scene, rtol=0, atol=0.02)
    similarity = torch.cosine_similarity(by_box, torch.cat([in_scene, of_other]))
    assert similarity[0] > similarity[1] + 0.1


def test_a_box_is_cut_out_undistorted():
    image = torch.zeros(3, 60, 80)
    image[:, 20:40, 30:50] = 1
    size = 12, 16  # as wide as the image: the cut has 20 x 27 px
    cut = cut_box(image, (30 / 80, 20 / 60, 50 / 80, 40 / 60), size)
    assert cut.shape == (3, *size)
    assert cut[:, :, 3:13].min() > 0.9
    assert cut[:, :, [0, -1]].max() < 0.1
    # At the edge of the image, its last pixels are repeated.
    assert cut_box(image + 0.5, (0, 0, 0.02, 0.02), size).min() == pytest.approx(0.5)


def test_options_are_pixels(tmp_path):
    assert read_prompt([16, 6], None, (32, 24)).location == (0, -0.5)
    box = read_prompt([8, 0, 24, 24], None, (32, 24))
    assert (box.box, box.location, box.is_point) == ((0.25, 0, 0.75, 1), (0, 0), False)
    Image.new("L", (40, 20), 255).save(tmp_path / "cup.png")
    photo = read_prompt(None, tmp_path / "cup.png", (32, 24))
    assert (photo.box, photo.image.shape) == ((0, 0, 1, 1), (3, 20, 40))
    assert read_prompt([10, 10], tmp_path / "cup.png", (32, 24)).is_point
    (tmp_path / "no.png").write_text("nothing")
    for numbers, file, message in (
        ([40, 6], None, "must lie in the picture, which has 32 x 24 px"),
        ([8, 8, 4, 12], None, r"a box is \[left, top, right, bottom\]"),
        ([1, 2, 3], None, "Got 3 numbers"),
        (None, tmp_path / "no.png", r"no.png cannot be read .* Name an image file"),
        (None, tmp_path / "missing.png", "missing.png cannot be read"),
    ):
        with pytest.raises(UserError, match=message):
            read_prompt(numbers, file, (32, 24))


def test_a_prompt_needs_a_sentence_and_company(table, trained):
    policy, before = trained
    for tasks, given, message in (
        ([""], [[point_at((0, 0))]], "but not where to put it. Give an instruction"),
        (["a", "b"], [[point_at((0, 0))], []], "one object prompt, or none of them any"),
    ):
        policy.reset()
        policy.set_tasks(tasks, given)
        with pytest.raises(UserError, match=message):
            policy.select_action(first_images(table, before, range(len(tasks))))


def test_the_policy_deltaco_takes_no_prompts(make):
    policy, _, _ = make()
    with pytest.raises(UserError, match="'deltaco' needs demonstrations"):
        policy.set_tasks(["a"], [[point_at((0, 0))]])
