"""How often it is told that the camera has moved, by shift and turn, and how often it has not.

    python benchmarks/camera_motion.py

Scenes are those of `finding.py`, drawn with a margin, of which the camera's part is cut out: shifted, turned,
and with other lighting. No robot moves.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import replace

import finding
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from lerobot_deltaco.policies.scene.camera_motion import (
    CameraMotion,
    estimate_motion,
    static_reference,
)

N_REMEMBERED = 48
COMPARED_SIZE = 128  # px, of the images as the policy remembers them
MARGIN = 1.3  # side of the scenes that are drawn, in sides of the camera's part
# Shift, px of an image that is 256 wide, and turn, degrees
MOTIONS = {
    "not moved": (0.0, 0.0),
    "shifted by 5 px": (5.0, 0.0),
    "shifted by 10 px": (10.0, 0.0),
    "shifted by 37 px": (37.0, 0.0),
    "turned by 1 degree": (0.0, 1.0),
    "turned by 2 degrees": (0.0, 2.0),
    "shifted by 10 px, turned by 2 degrees": (10.0, 2.0),
}


def wide(case: finding.Case) -> finding.Case:
    """Returns a case whose images have a margin around them."""
    fov = 2 * math.degrees(math.atan(MARGIN * math.tan(math.radians(case.camera.fov / 2))))
    width, height = (2 * round(MARGIN * side / 2) for side in case.size)
    return replace(case, camera=replace(case.camera, fov=fov), size=(width, height))


def cut(image: Tensor, size: tuple[int, int], shift: float, turn: float, rng: np.random.Generator) -> Tensor:
    """Cuts out what a camera shows, (3, height, width) in 0..1, that was moved in a random direction.

    Args:
        image: Image with a margin, (3, H, W) uint8.
        size: Width and height of the camera's image, px.
        shift: Distance by which the picture moves, px of an image that is 256 wide.
        turn: Angle by which it turns, degrees.
        rng: Source of the direction, and of the lighting.
    """
    width, height = size
    aspect, direction = width / height, rng.uniform(0, 2 * np.pi)
    right, down = 2 * aspect * shift / 256 * np.array([np.cos(direction), np.sin(direction)])
    angle = math.radians(turn * rng.choice([-1, 1]))
    y, x = torch.meshgrid(
        (torch.arange(height) + 0.5) / height * 2 - 1,
        (torch.arange(width) + 0.5) / width * 2 - 1,
        indexing="ij",
    )
    x = x * aspect - right
    y = y - down
    turned = torch.stack(
        [math.cos(angle) * x + math.sin(angle) * y, math.cos(angle) * y - math.sin(angle) * x], dim=-1
    )
    shown = (image.shape[2] / width, image.shape[1] / height)
    at = turned / torch.tensor([aspect * shown[0], shown[1]])
    part = F.grid_sample(image[None].float() / 255, at[None].float(), mode="bilinear", align_corners=False)[0]
    noise = torch.from_numpy(rng.normal(0, 0.01, tuple(part.shape))).float()
    return (part * rng.uniform(0.85, 1.15) + noise).clamp(0, 1)


def measure(case: finding.Case, n_scenes: int, seed: int) -> dict[str, list[CameraMotion]]:
    """Returns what is found for scenes of each motion."""
    scenes = finding.Scenes(wide(case), range(24), np.random.default_rng(seed))
    rng = np.random.default_rng((seed, 1))
    drawn = [
        scenes.episode(int(rng.integers(24)), int(rng.integers(2))).first
        for _ in range(N_REMEMBERED + n_scenes)
    ]

    def seen(image: Tensor, shift: float, turn: float) -> Tensor:
        part = cut(image, case.size, shift, turn, rng)
        return F.interpolate(part[None], (COMPARED_SIZE, COMPARED_SIZE), mode="bilinear", antialias=True)[0]

    reference = static_reference(torch.stack([seen(image, 0, 0) for image in drawn[:N_REMEMBERED]]))
    aspect = case.size[0] / case.size[1]
    return {
        name: [estimate_motion(reference, seen(image, *motion), aspect) for image in drawn[N_REMEMBERED:]]
        for name, motion in MOTIONS.items()
    }


def main() -> None:
    """Prints the rates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="+", default=["toy", "gym-24-100"], choices=finding.CASES)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--width", type=int, help="of the images, px; by default, that of the case")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for name in arguments.cases:
        start, case = time.process_time(), finding.CASES[name]
        width, height = case.size
        if arguments.width:
            height = round(height / width * arguments.width)
            width = arguments.width
        for motion, found in measure(
            replace(case, size=(width, height)), arguments.scenes, arguments.seed
        ).items():
            told = 100 * np.mean([each.is_significant for each in found])
            shifts = 256 * np.array(
                [math.hypot(each.shift[0], each.shift[1] * height / width) for each in found]
            )
            turns, gains = (np.array([getattr(each, key) for each in found]) for key in ("turn", "gain"))
            distances = 256 * np.array([each.distance for each in found])
            sys.stdout.write(
                f"{name:10} {motion:38} told in {told:5.1f} %; shift {np.median(shifts):5.1f} px, "
                f"turn {np.median(abs(turns)):4.1f} degrees; motion {np.quantile(distances, 0.05):5.2f} to "
                f"{np.quantile(distances, 0.95):5.2f} px; gain {np.quantile(gains, 0.05):.2f} to "
                f"{np.quantile(gains, 0.95):.2f}\n"
            )
            sys.stdout.flush()
        sys.stdout.write(f"{time.process_time() - start:.0f} s of a core\n")


if __name__ == "__main__":
    main()
