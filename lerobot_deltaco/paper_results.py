"""The paper's results by the experiment's name, and the names of experiments in tables and figures.

The authors measured them in their own simulation, with other objects: compare them with one another, not with
this project's rates.
"""

from __future__ import annotations

import re
from typing import NamedTuple

# Success rates of policies that know part of the task, in ambiguity scheme (i).
CHANCE = 1 / 6
LEVELS = {
    "random object and container": CHANCE,
    "right container, random object": 1 / 3,
    "right object, random container": 1 / 2,
}


class PaperResult(NamedTuple):
    """A row of the paper's tables 1 to 3 (results), 8 (ablations) or 9 (ambiguity).

    Attributes:
        label: Name of the row in tables and figures.
        rate: Success rate by the paper's protocol (`statistics.paper_rate`), 0..1.
        sd: Standard deviation of the rate over three seeds, 0..1.
    """

    label: str
    rate: float
    sd: float


# Rate and SD in %. Tables keep this order. The paper calls both rows of CLIP with an MLP head DeL-TaCo; the
# authors' README calls the first one language only, as its settings are.
_PERCENT = {
    "scenario_a/deltaco": ("DeL-TaCo", 25.8, 3.4),
    "scenario_a/demo_only": ("demo only", 20.8, 2.4),
    "scenario_a/language_only": ("language only", 17.1, 2.2),
    "scenario_a/bc_z": ("BC-Z", 6.7, 2.3),
    "scenario_a/mcil": ("MCIL", 7.5, 1.2),
    "scenario_a/one_hot": ("one-hot", 4.9, 1.7),
    "scenario_a/oracle": ("one-hot oracle", 69.3, 7.4),
    "scenario_a/clip_both": ("CLIP, both", 15.8, 2.2),
    "scenario_a/clip_demo": ("CLIP, demo only", 3.5, 1.0),
    "scenario_a/clip_language": ("CLIP, language only", 14.4, 2.4),
    "scenario_a/demo_only_finetuned_0": ("demo only, fine-tuned on 0", 20.8, 2.4),
    "scenario_a/demo_only_finetuned_10": ("demo only, fine-tuned on 10", 23.4, 1.8),
    "scenario_a/demo_only_finetuned_25": ("demo only, fine-tuned on 25", 24.6, 2.5),
    "scenario_a/demo_only_finetuned_50": ("demo only, fine-tuned on 50", 26.1, 2.6),
    "scenario_a/demo_only_finetuned_100": ("demo only, fine-tuned on 100", 32.9, 2.5),
    "scenario_b/deltaco": ("DeL-TaCo", 31.6, 5.2),
    "scenario_b/demo_only": ("demo only", 20.0, 4.0),
    "scenario_b/language_only": ("language only", 25.4, 5.7),
    "scenario_b/one_hot": ("one-hot", 8.4, 2.3),
    "scenario_b/oracle": ("one-hot oracle", 61.7, 14.0),
    "ambiguity_object/deltaco": ("DeL-TaCo", 30.5, 3.1),
    "ambiguity_object/demo_only": ("demo only", 27.5, 4.3),
    "ambiguity_object/language_only": ("language only", 18.4, 2.5),
    "ablations/distilroberta": ("DistilRoBERTa", 25.2, 2.9),
    "ablations/distilroberta_language_only": ("DistilRoBERTa, language only", 15.1, 2.7),
    "ablations/distilbert": ("DistilBERT", 27.1, 2.5),
    "ablations/distilbert_language_only": ("DistilBERT, language only", 9.4, 1.8),
    "ablations/clip_mlp_1": ("CLIP with an MLP head, language only", 10.7, 2.8),
    "ablations/clip_mlp_2": ("CLIP with an MLP head, both", 11.8, 3.2),
    "ablations/r3m": ("R3M", 13.5, 3.3),
    "ablations/cosine_loss": ("cosine loss", 12.5, 2.2),
    "ablations/no_encoder_loss": ("no encoder loss", 10.0, 3.3),
    "ablations/concat_everything": ("concat everything", 7.9, 4.5),
    "ablations/film_everything": ("FiLM everything", 22.4, 2.3),
}

# Experiments at a small scale, by the first part of their names, and the paper's tables that they repeat.
_REPEATED = {
    "small_a": ("scenario_a", "ablations"),
    "small_b": ("scenario_b",),
    "small_ambiguity": ("ambiguity_object",),
}
_OWN_LABELS = {
    "deltaco": "DeL-TaCo",
    "demo_only": "demo only",
    "either": "DeL-TaCo, takes either input",
    "deltaco_paraphrases": "DeL-TaCo, trained on paraphrases",
    "deltaco_paraphrases_templates": "DeL-TaCo, trained on paraphrases and templates",
    "deltaco_matching": "DeL-TaCo, feature matching",
    "deltaco_attention": "DeL-TaCo, attention encoder",
    "language_only_paraphrases": "language only, trained on paraphrases",
    "minilm_l3": "DeL-TaCo, MiniLM-L3",
    "minilm_l3_language_only": "language only, MiniLM-L3",
    "efficientnet_both": "EfficientNet, both",
    "efficientnet_demo": "EfficientNet, demo only",
    "efficientnet_head": "EfficientNet with an MLP head",
    "language_film_demo_concat": "FiLM(language), concat(demo)",
    "paper_architecture": "the paper's architecture",
    "objects_24": "24 training objects",
    "objects_100": "100 training objects",
    "objects_400": "400 training objects",
    "objects_400_either": "400 training objects, takes either input",
    "objects_400_either_matching": "400 training objects, takes either input, feature matching",
}
TITLES = {
    "scenario_a": "Scenario A: novel objects, colors and shapes",
    "scenario_b": "Scenario B: novel colors and shapes",
    "ambiguity_object": "Ambiguity scheme (ii): identical objects",
    "ablations": "Ablations, in scenario A",
    "small_a": "Scenario A at a small scale, not the paper's architecture",
    "small_b": "Scenario B at a small scale, not the paper's architecture",
    "small_ambiguity": "Ambiguity scheme (ii) at a small scale, not the paper's architecture",
}
PAPER_RESULTS = {
    name: PaperResult(label, rate / 100, sd / 100) for name, (label, rate, sd) in _PERCENT.items()
}


def paper_result(experiment: str) -> PaperResult | None:
    """Returns the paper's result of an experiment or of the one that it repeats; None if there is none."""
    return PAPER_RESULTS.get(_paper_row(experiment))


def small_scale_experiment(row: str) -> str:
    """Returns the experiment that repeats a row of the paper, such as "small_a/cosine_loss"."""
    table, _, name = row.rpartition("/")
    name = name.removesuffix("_finetuned_0")  # no fine-tuning
    return next(f"{group}/{name}" for group, tables in _REPEATED.items() if table in tables)


def label_of(experiment: str) -> str:
    """Returns the name of an experiment in tables and figures: the paper's name for it, else its own."""
    published = paper_result(experiment)
    name = experiment.rpartition("/")[2]
    return _OWN_LABELS.get(name, name.replace("_", " ")) if published is None else published.label


def title_of(group: str) -> str:
    """Returns the title of a group: the experiments whose names begin alike."""
    return TITLES.get(group, group or "Experiments")


def in_order(experiment: str) -> tuple[int, str, int, tuple[tuple[int, str], ...]]:
    """Returns a key that sorts experiments in the paper's order, and others by name, numbers by value."""
    group = experiment.rpartition("/")[0]
    titles, names = list(TITLES), list(PAPER_RESULTS)
    row = _paper_row(experiment)
    return (
        titles.index(group) if group in titles else len(titles),
        group,
        names.index(row) if row in names else len(names),
        tuple((int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", experiment)),
    )


def _paper_row(experiment: str) -> str:
    """Returns the name of the paper's row that an experiment repeats, else its own name."""
    group, _, name = experiment.rpartition("/")
    rows = (f"{table}/{name}" for table in _REPEATED.get(group, ()))
    return next((row for row in rows if row in PAPER_RESULTS), experiment)
