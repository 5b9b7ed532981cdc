"""Collections in this process, whose episodes are simulated once, for tests that repeat them."""

from concurrent.futures import Executor, Future

from lerobot_deltaco.data import collection, collection_workers
from lerobot_deltaco.data import dataset_files as files
from lerobot_deltaco.data.collection_plan import collect_episode


class InProcess(Executor):
    """Does the workers' jobs at once, in this process."""

    def submit(self, function, /, *arguments):
        future = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future


def remember_episodes(env):
    """`collect_episode`, which simulates each episode only once."""
    episodes = {}

    def collect_remembered(_, plan, task_id, number):
        key = plan.seed, plan.split, plan.noise, task_id, number
        if key not in episodes:
            episodes[key] = collect_episode(env, plan, task_id, number)
        return episodes[key]

    return collect_remembered


def collect_in_process(monkeypatch, remembered, episodes_per_file):
    """Lets collections run in this process, so that faults can be injected into every part of them.

    Returns:
        The episodes that were collected: (task, number).
    """
    collected = []

    def collect_and_count(env, plan, task_id, number):
        collected.append((task_id, number))
        return remembered(env, plan, task_id, number)

    def executor(job, n_workers):
        worker = collection_workers._Worker(job, None, files.data_schema(job.plan.features))
        monkeypatch.setattr(collection_workers, "_worker", worker)
        return InProcess()

    monkeypatch.setattr(collection_workers, "collect_episode", collect_and_count)
    monkeypatch.setattr(collection_workers, "_executor", executor)
    monkeypatch.setattr(collection, "EPISODES_PER_FILE", episodes_per_file)
    return collected
