"""Steps of experiments that run nothing."""

import itertools
import json

from example_records import make_record

from lerobot_deltaco.errors import UserError
from lerobot_deltaco.evaluation.checkpoints import find_checkpoints
from lerobot_deltaco.evaluation.records import write_records
from lerobot_deltaco.experiments import run as experiments

CONFIG = {"type": "deltaco", "input_features": {"image": {"type": "VISUAL", "shape": [3, 48, 48]}}}


class FakeSteps:
    """Leaves what the steps would leave. `failing` is the name of one that fails before its end."""

    def __init__(self):
        self.failing, self.names, self.configs = None, [], []

    def _begin(self, name):
        self.names.append(name)
        return name == self.failing

    def _end(self, fails):
        if fails:
            raise UserError("failed")

    def collect(self, root, plan, workers):
        fails = self._begin("collect")
        (root / "meta").mkdir(parents=True, exist_ok=True)
        for name in () if fails else ("info.json", "deltaco.json"):
            (root / "meta" / name).write_text("{}")
        self._end(fails)

    def train(self, function, argument):
        fails = self._begin(function.__name__.strip("_"))
        if function is experiments._train:
            self.configs.append(argument)
            self._leave_checkpoints(argument.output_dir, argument.steps, argument.save_freq, fails)
        else:
            run = argument.parents[2]
            options = json.loads((argument / "train_config.json").read_text())
            self._leave_checkpoints(run, options["steps"], options["save_freq"], fails)
        self._end(fails)

    def _leave_checkpoints(self, run, steps, save_freq, fails):
        for step in range(save_freq, steps + 1, save_freq):
            job_name = str(run.parent.relative_to(run.parents[2]))
            contents = {
                "pretrained_model/train_config.json": {
                    "steps": steps,
                    "save_freq": save_freq,
                    "job_name": job_name,
                },
                "pretrained_model/config.json": CONFIG,
                "pretrained_model/model.safetensors": {},
                "training_state/training_step.json": {"step": step},
            }
            for name, (file, content) in itertools.product((f"{step:06}", "last"), contents.items()):
                path = run / "checkpoints" / name / file
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps(content))
            if fails:
                break

    def evaluate(self, arguments):
        fails = self._begin("evaluate")
        run = arguments.checkpoint
        for step in (checkpoint.step for checkpoint in find_checkpoints(run)):
            if not fails:
                self.record(run, step, arguments.plan)
        self._end(fails)
        return "50.0 % succeeded."

    def record(self, run, step, plan):
        path = run / "evaluations" / f"{step:06}.parquet"
        if not path.exists():
            experiment, seed = run.parent.relative_to(run.parents[2]), int(run.name.removeprefix("seed_"))
            # Later seeds succeed more often.
            record = make_record(str(experiment), seed, step, lambda _, trial: trial < seed, plan=vars(plan))
            write_records(path, [record])

    def report(self, paths, out):
        self.names.append("report")
        return out / "report.md"


def fake_steps(monkeypatch, fake):
    monkeypatch.setattr(experiments, "collect", fake.collect)
    monkeypatch.setattr(experiments, "call_in_new_process", fake.train)
    monkeypatch.setattr(experiments, "evaluate_checkpoints", fake.evaluate)
    monkeypatch.setattr(experiments, "write_report", fake.report)
    return fake
