"""Replays demonstrated trajectories at other pick and place locations.

The states of a demonstration are moved to the new scene: its approach ends at the new pick location, what it
carries goes to the new place location. In between, the displacement changes smoothly along the path, so that
the last part before the grasp and before the release has the demonstrated shape. Each action is the recorded
one, corrected for what the moved states ask for in addition, by linear inverse dynamics: how actions follow
from the robot's state, and from where it is some frames later. They are fitted to the training episodes, so
that they serve displacements of the end effector and targets of joints alike.

Nothing here looks at images.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from lerobot_deltaco.data.demonstrations import Demonstration
from lerobot_deltaco.data.grasps import Grasp, find_grasps
from lerobot_deltaco.data.gripper import Gripper
from lerobot_deltaco.data.object_prompts import ObjectPrompt
from lerobot_deltaco.errors import UserError

# Frames after which the effect of an action is looked for: at most so many, and this part of an episode.
_MAX_LAG, _STEPS_PER_LAG = 8, 4
_RIDGE = 1e-5  # of the inverse dynamics, as a fraction of the number of samples
# Parts of the path before the grasp, and before the release, in which the displacement changes.
_APPROACH_BLEND, _CARRY_BLEND = (0.0, 0.6), (0.15, 0.75)
# Distance from the moved trajectory within which its next state is approached: this much of its local step,
# but this much of a usual one where the gripper closes and opens, and no less anywhere.
_STEPS_APART, _LEAST_APART = 1.0, 0.05
_PASSED = 3.0  # tolerances within which a state counts as reached if the one after it is nearer
_LEAST_APPROACH = 0.1  # of the tolerance, in a frame that comes closer
_MAX_WAIT = 2  # frames that a state is waited for without coming closer
_STILL = 0.05  # of a usual step, within which an arm stands still
_LEAVES = 0.5  # usual steps away from where the gripper was commanded, from which on an arm no longer waits
_COMMAND_CHANGE = 0.05  # of the range of a gripper's commands; less is no change
_LEAST_EXPLAINED = 0.1  # of the variance of an action, by the dimension of the state that it moves
_VELOCITY = 0.8  # coefficient of determination above which a dimension is a velocity
_MAX_STORED = 48  # trajectories of training episodes
_STORED = ("stored_states", "stored_actions", "stored_lengths", "grasp_states")


class Trajectory(NamedTuple):
    """A demonstration's states and actions, and its grasp.

    Attributes:
        states: (frames, state), normalized.
        actions: (frames, action), normalized.
        grasp: Its grasp.
        grasp_states: States at the grasp and at the release, as in the dataset, (2, state).
    """

    states: Tensor
    actions: Tensor
    grasp: Grasp
    grasp_states: Tensor


class Reference(NamedTuple):
    """Trajectories that are followed, moved to the scenes of a batch; the shorter ones are padded at the end.

    Attributes:
        states: Moved states, (batch, frames, state).
        steps: How far the demonstration moves within `lag` frames from each, (batch, frames, state).
        recorded: Demonstrated states, (batch, frames, state).
        actions: Recorded actions, (batch, frames, action).
        tolerances: Distance within which a state counts as reached, (batch, frames).
        frame: Frame that the robot is at, (batch,) int64.
        waited: Frames that it has waited there without coming closer to the next state, (batch,) int64.
        distance: Distance from the next state, (batch,).
    """

    states: Tensor
    steps: Tensor
    recorded: Tensor
    actions: Tensor
    tolerances: Tensor
    frame: Tensor
    waited: Tensor
    distance: Tensor


class TrajectoryReplay(nn.Module):
    """Follows trajectories at other locations.

    Args:
        state_dim: Size of the robot's state.
        action_dim: Size of an action.

    Attributes:
        displacement_gain: Change of an action per displacement `lag` frames later, (state, action).
        state_gain: Change of an action per change of the present state, (state, action).
        lag: Frames after which the effect of an action is looked for, () int64.
        is_arm: 1 for the dimensions of the state that are followed, else 0, (state,).
        usual_step: Distance that is usual between successive states, as the size of an action, ().
        grasp_states: States at the grasps and releases of stored trajectories, as in the dataset,
            (trajectories, 2, state).
    """

    displacement_gain: Tensor
    state_gain: Tensor
    lag: Tensor
    is_arm: Tensor
    usual_step: Tensor
    action_scale: Tensor
    action_shift: Tensor
    state_scale: Tensor
    state_shift: Tensor
    stored_states: Tensor
    stored_actions: Tensor
    stored_lengths: Tensor
    grasp_states: Tensor

    def __init__(self, state_dim: int, action_dim: int) -> None:
        super().__init__()
        self.register_buffer("displacement_gain", torch.zeros(state_dim, action_dim))
        self.register_buffer("state_gain", torch.zeros(state_dim, action_dim))
        self.register_buffer("lag", torch.ones((), dtype=torch.int64))
        self.register_buffer("is_arm", torch.ones(state_dim))
        self.register_buffer("usual_step", torch.ones(()))
        # An action as it is predicted is action_scale * action + action_shift; so are states.
        self.register_buffer("action_scale", torch.zeros(action_dim))
        self.register_buffer("action_shift", torch.zeros(action_dim))
        self.register_buffer("state_scale", torch.ones(state_dim))
        self.register_buffer("state_shift", torch.zeros(state_dim))
        # States and actions of training episodes, one after the other, as in the dataset.
        self.register_buffer("stored_states", torch.zeros(0, state_dim))
        self.register_buffer("stored_actions", torch.zeros(0, action_dim))
        self.register_buffer("stored_lengths", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("grasp_states", torch.zeros(0, 2, state_dim))
        self.register_load_state_dict_pre_hook(self._make_room)

    @staticmethod
    def _make_room(module: TrajectoryReplay, state_dict: dict[str, Tensor], prefix: str, *_: Any) -> None:
        """Makes the buffers of stored trajectories as large as those that are loaded."""
        for name in _STORED:
            loaded = state_dict.setdefault(prefix + name, getattr(module, name))
            setattr(module, name, getattr(module, name).new_empty(loaded.shape))

    def fit(self, trajectories: Sequence[tuple[Tensor, Tensor]], is_arm: Tensor, gripper_index: int) -> None:
        """Fits the inverse dynamics.

        Args:
            trajectories: States (frames, state) and actions (frames, action) of episodes, normalized.
            is_arm: Dimensions of the state other than the gripper's, (state,) bool.
            gripper_index: Dimension of the action that is the gripper.
        """
        lengths = sorted(len(states) for states, _ in trajectories)
        # Of a usual episode: a single one that was cut short must not decide.
        n_lags = max(1, min(_MAX_LAG, lengths[len(lengths) // 2] // _STEPS_PER_LAG))
        trajectories = [each for each in trajectories if len(each[0]) > n_lags]
        states = torch.cat([s[:-n_lags] for s, _ in trajectories]).double()
        later = [
            torch.cat([s[lag : len(s) - n_lags + lag] for s, _ in trajectories]).double()
            for lag in range(1, n_lags + 1)
        ]
        actions = torch.cat([a[:-n_lags] for _, a in trajectories]).double()
        actions[:, gripper_index] = 0
        for buffer in (self.is_arm, self.displacement_gain, self.state_gain):
            buffer.zero_()
        candidates = (is_arm & ~_velocities([s for s, _ in trajectories])).nonzero().flatten().tolist()
        least = float("inf")
        for lag, each in enumerate(later, start=1):
            moved = _moved_dimensions(states, each, actions, candidates)
            error, weights = _inverse_dynamics(states[:, moved], each[:, moved], actions)
            if moved and error < least:
                least, n = error, len(moved)
                self.lag.fill_(lag)
                for buffer in (self.is_arm, self.displacement_gain, self.state_gain):
                    buffer.zero_()
                self.is_arm[moved] = 1
                self.displacement_gain[moved] = weights[:n].to(self.is_arm)
                self.state_gain[moved] = weights[n : 2 * n].to(self.is_arm)
        steps = torch.cat([self._distance(s[1:] - s[:-1]) for s, _ in trajectories])
        self.usual_step.copy_(steps.quantile(0.9))

    @property
    def is_blind(self) -> bool:
        """Whether no dimension of the robot's state follows its actions: trajectories cannot be moved."""
        return not bool(self.is_arm.any())

    def store(self, episodes: Sequence[tuple[Tensor, Tensor]], command: Gripper) -> None:
        """Stores trajectories of some training episodes, for tasks without a demonstrated one.

        Args:
            episodes: States (frames, state) and actions (frames, action) of each, as in the dataset.
            command: How the gripper is read from an action.
        """
        read = [(each, self._trajectory(*each, command)) for each in episodes]
        usable = [(each, found) for each, found in read if isinstance(found, Trajectory)]
        usable = usable[:: -(-len(usable) // _MAX_STORED) or 1]
        states, actions = zip(*(each for each, _ in usable), strict=True)
        self.stored_states, self.stored_actions = torch.cat(states).float(), torch.cat(actions).float()
        self.stored_lengths = torch.tensor([len(each) for each in states], device=self.is_arm.device)
        self.grasp_states = torch.stack([found.grasp_states for _, found in usable])

    @property
    def n_trajectories(self) -> int:
        """Number of stored trajectories."""
        return len(self.grasp_states)

    def stored_trajectory(self, number: int, command: Gripper) -> Trajectory:
        """Returns a stored trajectory. See `store`."""
        lengths = self.stored_lengths.tolist()
        states, actions = (each.split(lengths)[number] for each in (self.stored_states, self.stored_actions))
        found = self._trajectory(states, actions, command)
        assert isinstance(found, Trajectory)
        return found

    def _distance(self, displacements: Tensor) -> Tensor:
        """Returns the size of the actions that make displacements of states, (...)."""
        return (displacements @ self.displacement_gain).norm(dim=-1)

    def trajectory(
        self, demonstration: Demonstration | ObjectPrompt | None, command: Gripper
    ) -> Trajectory | str:
        """Returns the trajectory of a demonstration, or the reason why it cannot be replayed.

        Args:
            demonstration: The demonstration; None if there is none.
            command: How the gripper is read from an action.

        Raises:
            ValueError: Nothing was fitted.
        """
        if not bool(self.action_scale.any()):
            raise UserError(
                "The checkpoint was trained by a version that could not replay demonstrations. Train it "
                "again, or act with --policy.acting=network."
            )
        if self.is_blind:
            return "no dimension of the robot's state follows its actions"
        if not isinstance(demonstration, Demonstration):
            return "no demonstration is given"
        if demonstration.states is None or demonstration.actions is None:
            return "the demonstration has no states and actions of the robot"
        return self._trajectory(demonstration.states, demonstration.actions, command)

    def _trajectory(self, states: Tensor, actions: Tensor, command: Gripper) -> Trajectory | str:
        """Returns the trajectory of an episode, or the reason why it has no grasp."""
        states, actions = (each.to(self.is_arm.device).float() for each in (states, actions))
        scaled = states * self.state_scale + self.state_shift
        moving = self._moving(scaled, command.opening(actions))
        states, scaled, actions = (each[moving] for each in (states, scaled, actions))
        span = (0, len(states) - 1)
        (grasp,) = find_grasps(command.opening(actions), [span], command.usual_range, states)
        if isinstance(grasp, str):
            return grasp
        # The command to close takes effect one step later.
        grasp = grasp._replace(grasp=min(grasp.grasp + 1, grasp.release))
        return Trajectory(
            scaled,
            actions * self.action_scale + self.action_shift,
            grasp,
            states[[grasp.grasp, grasp.release]],
        )

    def _moving(self, states: Tensor, opening: Tensor) -> list[int]:
        """Returns the frames that are not pauses: none is repeated in which the arm hesitated.

        After a command to close or to open, the arm waits on purpose until it leaves.

        Args:
            states: States of an episode, normalized, (frames, state).
            opening: How far the gripper is commanded to open, (frames,).
        """
        least = _STILL * self.usual_step
        is_change = (opening[1:] - opening[:-1]).abs() > _COMMAND_CHANGE * (opening.max() - opening.min())
        kept, waits_at = [0], None
        for frame in range(1, len(states)):
            if bool(is_change[frame - 1]):
                waits_at = frame
            elif waits_at is not None:
                left = bool(self._distance(states[frame] - states[waits_at]) > _LEAVES * self.usual_step)
                waits_at = None if left else waits_at
            has_moved = bool(self._distance(states[frame] - states[kept[-1]]) > least)
            if has_moved or waits_at is not None or frame == len(states) - 1:
                kept.append(frame)
        return kept

    def start(
        self,
        trajectories: Sequence[Trajectory],
        state: Tensor,
        displacements: Tensor,
    ) -> Reference:
        """Moves trajectories to new scenes.

        Args:
            trajectories: One for each sample.
            state: The robot's state, (batch, state), normalized.
            displacements: Where the states at the grasp and at the release are, minus where they were in the
                demonstration, (batch, 2, state).
        """
        n_frames = max(len(each.states) for each in trajectories)
        recorded = torch.stack([_padded(each.states, n_frames) for each in trajectories])
        actions = torch.stack([_padded(each.actions, n_frames) for each in trajectories])
        start = (state - recorded[:, 0]) * self.is_arm
        moved = []
        for n, each in enumerate(trajectories):
            shares = _shares(each.states * self.is_arm, each.grasp)  # (frames, 3)
            targets = torch.cat([start[n : n + 1], displacements[n]]) * self.is_arm
            moved.append(_padded(each.states + shares @ targets, n_frames))
        states = torch.stack(moved)
        lag = int(self.lag)
        later = torch.cat([recorded[:, lag:], recorded[:, -1:].expand(-1, lag, -1)], dim=1)[:, :n_frames]
        step = self._distance(states[:, 1:] - states[:, :-1])
        least = _LEAST_APART * self.usual_step
        tolerances = (_STEPS_APART * torch.cat([step[:, :1], step], dim=1)).clamp_min(least)
        for row, each in zip(tolerances, trajectories, strict=True):
            for frame in (each.grasp.closing, each.grasp.closing + 1, each.grasp.release):
                row[frame] = least
        zeros = torch.zeros(len(states), dtype=torch.int64, device=states.device)
        return Reference(
            states,
            later - recorded,
            recorded,
            actions,
            tolerances,
            zeros,
            zeros,
            torch.full(zeros.shape, torch.inf, device=states.device),
        )

    def follow(self, reference: Reference, state: Tensor) -> tuple[Reference, Tensor]:
        """Returns the reference after a step, and the action, (batch, action), normalized.

        Args:
            reference: What is followed.
            state: The robot's state, (batch, state), normalized.
        """
        rows = torch.arange(len(state), device=state.device)
        lag, last = int(self.lag), reference.states.shape[1] - 1
        wanted = (reference.frame + 1).clamp(max=last)
        distance = self._distance(state - reference.states[rows, wanted])
        tolerance = reference.tolerances[rows, wanted]
        beyond = self._distance(state - reference.states[rows, (wanted + 1).clamp(max=last)])
        is_passed = (beyond < distance) & (distance < _PASSED * tolerance)
        comes_closer = distance < reference.distance - _LEAST_APPROACH * tolerance
        waited = torch.where(comes_closer, 0, reference.waited + 1)
        is_reached = (distance <= tolerance) | is_passed
        # An arm that came no closer once, as one that sags, is not waited for again until it does.
        goes_on = is_reached | (waited > _MAX_WAIT)
        frame = torch.where(goes_on, wanted, reference.frame)
        waited = torch.where(is_reached, 0, waited)
        distance = torch.where(is_reached, torch.inf, distance)
        target = reference.states[rows, (frame + lag).clamp(max=last)]
        additional = target - state - reference.steps[rows, frame]
        aside = state - reference.recorded[rows, frame]
        recorded = reference.actions[rows, frame]
        action = recorded + additional @ self.displacement_gain + aside @ self.state_gain
        # No action is farther out than those of the training episodes and of the demonstration itself.
        action = action.clamp(recorded.clamp(max=-1), recorded.clamp(min=1))
        return reference._replace(frame=frame, waited=waited, distance=distance), action


def _inverse_dynamics(states: Tensor, later: Tensor, actions: Tensor) -> tuple[float, Tensor]:
    """Returns the error and the weights of a regression of actions on displacements and states."""
    inputs = torch.cat([later - states, states, torch.ones_like(states[:, :1])], dim=1)
    gram = inputs.T @ inputs
    gram.diagonal().add_(_RIDGE * len(inputs))
    weights = torch.linalg.solve(gram, inputs.T @ actions)
    return float((inputs @ weights - actions).square().mean()), weights


def _moved_dimensions(states: Tensor, later: Tensor, actions: Tensor, candidates: Sequence[int]) -> list[int]:
    """Returns the dimensions of the state that actions move: of each, the one that explains it best.

    All others, such as joints beside an end effector's position, would contradict these once they are moved.
    """
    moved = set()
    variance = actions.var(dim=0)
    for n in (variance > 1e-8).nonzero().flatten().tolist():
        action = actions[:, [n]]
        errors = [_inverse_dynamics(states[:, [dim]], later[:, [dim]], action)[0] for dim in candidates]
        best = min(range(len(candidates)), key=errors.__getitem__)
        if errors[best] < (1 - _LEAST_EXPLAINED) * variance[n]:
            moved.add(candidates[best])
    return sorted(moved)


def _velocities(episodes: Sequence[Tensor]) -> Tensor:
    """Returns which dimensions of states are velocities, (state,) bool: linear in changes of the others."""
    values = torch.cat([states[1:-1] for states in episodes]).double()
    changes = torch.cat([states[2:] - states[:-2] for states in episodes]).double()
    values = values - values.mean(dim=0)
    gram = changes.T @ changes
    gram.diagonal().add_(1e-6 * len(changes))
    is_velocity = torch.zeros(values.shape[1], dtype=torch.bool, device=values.device)
    for dim in range(values.shape[1]):
        others = [other for other in range(values.shape[1]) if other != dim]
        weights = torch.linalg.solve(gram[others][:, others], changes[:, others].T @ values[:, dim])
        rest = values[:, dim] - changes[:, others] @ weights
        is_velocity[dim] = rest.square().mean() < (1 - _VELOCITY) * values[:, dim].square().mean()
    return is_velocity


def _padded(values: Tensor, n_frames: int) -> Tensor:
    """Repeats the last row of values (frames, ...)."""
    return torch.cat([values, values[-1:].expand(n_frames - len(values), *values.shape[1:])])


def _shares(states: Tensor, grasp: Grasp) -> Tensor:
    """Returns how much of the displacements of start, grasp and release each state has, (frames, 3)."""
    step = torch.cat([states.new_zeros(1), (states[1:] - states[:-1]).norm(dim=1)])
    travelled = step.cumsum(dim=0)
    picked = _ramp(travelled, travelled[0], travelled[grasp.closing], _APPROACH_BLEND)
    placed = _ramp(travelled, travelled[grasp.grasp], travelled[grasp.release], _CARRY_BLEND)
    frames = torch.arange(len(states), device=states.device)
    picked = torch.where(frames >= grasp.closing, 1.0, picked)
    placed = torch.where(frames <= grasp.grasp, 0.0, torch.where(frames >= grasp.release, 1.0, placed))
    return torch.stack([1 - picked, picked - placed, placed], dim=1)


def _ramp(travelled: Tensor, first: Tensor, last: Tensor, blend: tuple[float, float]) -> Tensor:
    """Returns a smooth step from 0 to 1 along a part of a path, (frames,)."""
    along = (travelled - first) / (last - first).clamp_min(1e-6)
    x = ((along - blend[0]) / (blend[1] - blend[0])).clamp(0, 1)
    return x * x * (3 - 2 * x)
