"""Policies that are trained and evaluated on sentences that people wrote."""

import functools
from collections import Counter

import pytest
import torch
from small_policies import (
    EPISODES_PER_TASK,
    TASKS,
    batch_of,
    fake_encoder,
    observation,
    small_policy,
    use_fake_encoder,
    write_dataset,
)

from gym_deltaco.tasks import get_task
from lerobot_deltaco.configuration_deltaco import DeltacoConfig
from lerobot_deltaco.data.paraphrases import read_paraphrases
from lerobot_deltaco.modeling_deltaco import DeltacoPolicy
from lerobot_deltaco.policy.language.paraphrases import Paraphrases

WORDS = {
    TASKS[0]: ["pile up the cups", "cups on cups"],
    TASKS[1]: ["fill the mugs", "do it"],
    TASKS[2]: ["say hello", "do it"],
}


@pytest.fixture(autouse=True)
def _language(monkeypatch):
    use_fake_encoder(monkeypatch)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    episodes = [task for task in TASKS for _ in range(EPISODES_PER_TASK[task])]
    return write_dataset(tmp_path_factory.mktemp("data") / "foreign", episodes)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """A dataset with a demonstration of each task."""
    return write_dataset(tmp_path_factory.mktemp("data") / "demos", TASKS)


@pytest.fixture
def make(dataset, demos):
    return functools.partial(small_policy, dataset, demo_repo_id="test/foreign", demo_root=str(demos.root))


def test_a_file_is_read_by_task_string(tmp_path):
    file = tmp_path / "sentences.csv"
    file.write_text("task_id,instruction\n4,first\n4,second\n")
    assert read_paraphrases(file) == {get_task(4).instruction: ("first", "second")}
    assert read_paraphrases(file, "train") == {get_task(4).instruction: ("first",)}


def test_sentences_are_drawn_evenly_and_repeatably():
    paraphrases = Paraphrases(WORDS, WORDS)
    draws = [paraphrases.draw([TASKS[0]] * 1000, torch.Generator().manual_seed(3)) for _ in range(2)]
    assert draws[0] == draws[1]
    counts = Counter(draws[0])
    assert set(counts) == set(WORDS[TASKS[0]])
    assert min(counts.values()) > 400
    with_templates = Paraphrases(WORDS, WORDS, with_templates=True)
    counts = Counter(with_templates.draw([TASKS[0]] * 3000, torch.Generator()))
    assert set(counts) == {TASKS[0], *WORDS[TASKS[0]]}
    assert min(counts.values()) > 900


def test_a_task_without_a_sentence_is_named_unless_its_template_is_drawn():
    with pytest.raises(ValueError, match="no sentence for the task 'sing'.*instructions_templates"):
        Paraphrases(WORDS, WORDS).draw(["sing"], torch.Generator())
    assert Paraphrases(WORDS, WORDS, with_templates=True).draw(["sing"], torch.Generator()) == ["sing"]


def test_each_samples_instruction_is_drawn_from_its_tasks(make, dataset, monkeypatch):
    policy, before, _ = make()
    policy.paraphrases = Paraphrases(WORDS, WORDS)
    batch = before(batch_of(dataset, list(range(30))))
    policy(batch)
    # The encoder was asked once for all sentences.
    assert fake_encoder.calls == [list(dict.fromkeys(sum(WORDS.values(), [])))]
    embedded = []
    table = policy.instructions.__call__
    monkeypatch.setattr(
        type(policy.instructions),
        "__call__",
        lambda self, texts, *rest, **more: embedded.append(list(texts)) or table(texts, *rest, **more),
    )
    policy.step.zero_()
    first, again = policy(batch)[0].item(), None
    drawn, embedded[:] = list(embedded), []
    policy.step.zero_()
    again = policy(batch)[0].item()
    assert (first, drawn) == (again, embedded)
    tasks, samples = drawn
    for names, sentences in ((dict.fromkeys(batch["task"]), tasks), (batch["task"], samples)):
        assert len(sentences) == len(names)
        assert all(text in WORDS[task] for task, text in zip(names, sentences, strict=True))
    assert len(set(samples)) > 3
    policy(batch)
    assert embedded[-1] != samples


def test_without_sentences_nothing_else_is_drawn(make, dataset):
    losses = []
    for paraphrases in (None, Paraphrases(WORDS)):
        torch.manual_seed(0)
        policy, before, _ = make()
        policy.paraphrases = paraphrases
        losses.append([policy(before(batch_of(dataset, [0, 7, 20])))[0].item() for _ in range(2)])
    assert losses[0] == losses[1]


def test_a_sentence_has_the_demonstrations_of_its_task(make, dataset, caplog):
    policy, before, _ = make(method="demo_only")
    policy.eval()
    expected = [policy.select_action(before(observation(dataset, [task]))) for task in TASKS]
    policy.paraphrases = Paraphrases(WORDS)
    for task, action in zip(TASKS, expected, strict=True):
        policy.reset()
        observed = before(observation(dataset, [f" {WORDS[task][0].upper()} "]))
        torch.testing.assert_close(policy.select_action(observed), action)
    policy.reset()
    observed = before(observation(dataset, ["do it"]))
    torch.testing.assert_close(policy.select_action(observed), expected[1])
    assert "may mean 2 tasks" in caplog.text
    # What is said explicitly comes first.
    with policy.demonstrated_as({"do it": TASKS[2]}):
        policy.reset()
        torch.testing.assert_close(policy.select_action(observed), expected[2])


def test_a_named_task_demonstrates_any_words(make, dataset):
    policy, before, _ = make(method="demo_only")
    policy.eval()
    expected = policy.select_action(before(observation(dataset, [TASKS[1]])))
    policy.config.demo_task = TASKS[1]
    policy.reset()
    observed = before(observation(dataset, ["fil teh mugs"]))
    torch.testing.assert_close(policy.select_action(observed), expected)


def test_a_checkpoint_knows_the_sentences_and_names_no_file(make, dataset, tmp_path):
    policy, before, _ = make()
    policy.paraphrases = Paraphrases(WORDS, WORDS)
    policy(before(batch_of(dataset, [0, 7])))
    policy.eval()
    observed = before(observation(dataset, ["cups on cups"]))
    expected = policy.select_action(observed)
    policy.config.instructions = str(tmp_path / "sentences.csv")
    policy.save_pretrained(tmp_path / "policy")
    assert policy.config.instructions is not None
    assert str(tmp_path) not in (tmp_path / "policy" / "config.json").read_text()
    fake_encoder.calls = []
    loaded = DeltacoPolicy.from_pretrained(tmp_path / "policy")
    assert torch.equal(loaded.select_action(observed), expected)
    assert fake_encoder.calls == []
    assert loaded.paraphrases.known == WORDS
    assert loaded.paraphrases.drawn == {}


def test_the_file_of_the_configuration_is_read(make, tmp_path):
    file = tmp_path / "sentences.csv"
    file.write_text("task_id,instruction\n4,first\n4,second\n")
    policy, _, _ = make(instructions=str(file))
    task = get_task(4).instruction
    assert policy.paraphrases.known == {task: ["first", "second"]}
    assert policy.paraphrases.drawn == {task: ["first"]}
    with pytest.raises(ValueError, match="`instructions_split` must be one of all, train, held_out"):
        DeltacoConfig(device="cpu", instructions_split="test")
    with pytest.raises(ValueError, match=r"missing.csv cannot be read"):
        make(instructions="missing.csv")


# Lengths of embeddings, and layers behind the encoder


def longer_encoder(name):
    """The fake encoder's vectors, three times as long."""
    encode = fake_encoder(name)
    return lambda sentences: 3 * encode(sentences)


@pytest.mark.parametrize(
    ("options", "length"),
    [
        ({}, 1),
        ({"normalize_language": False}, 1),
        ({"method": "language_only"}, 1),
        ({"method": "language_only", "normalize_language": False}, 3),
        ({"encoder_loss": "none", "normalize_language": False}, 3),
        ({"method": "language_only", "language_head": [8]}, 1),
        ({"method": "mcil"}, 1),
    ],
    ids=str,
)
def test_instructions_have_unit_length_unless_they_are_wanted_as_they_are(
    make, dataset, monkeypatch, options, length
):
    monkeypatch.setattr(
        "lerobot_deltaco.policy.language.instruction_table.load_language_encoder", longer_encoder
    )
    policy, before, _ = make(**options)
    embedded = policy._embedder.embed_instructions(TASKS, torch.device("cpu"))
    torch.testing.assert_close(embedded.norm(dim=1), torch.full((3,), float(length)))
    policy(before(batch_of(dataset, [0, 7, 20])))[0].backward()


def test_embeddings_of_the_first_version_stay_of_unit_length(make, monkeypatch, tmp_path):
    from safetensors.torch import save_file

    save_file(
        {"embeddings": torch.nn.functional.normalize(torch.randn(1, 384), dim=1)},
        tmp_path / "old.safetensors",
        metadata={"language_encoder": "paraphrase-MiniLM-L3-v2", "instructions": '["stack the cups"]'},
    )
    monkeypatch.setattr(
        "lerobot_deltaco.policy.language.instruction_table.load_language_encoder", longer_encoder
    )
    policy, _, _ = make(
        method="language_only",
        normalize_language=False,
        instruction_embeddings=str(tmp_path / "old.safetensors"),
    )
    embedded = policy._embedder.embed_instructions(TASKS, torch.device("cpu"))
    torch.testing.assert_close(embedded.norm(dim=1), torch.ones(3))
    policy.save_pretrained(tmp_path / "policy")
    loaded = DeltacoPolicy.from_pretrained(tmp_path / "policy")
    assert loaded.instructions.only_unit


def test_mcils_language_goes_through_the_authors_layers(make):
    policy, _, _ = make(method="mcil")
    shapes = [tuple(parameter.shape) for parameter in policy.language_head.parameters()]
    assert shapes == [(384, 384), (384,), (384, 384), (384,)]
    assert make()[0].language_head is None
