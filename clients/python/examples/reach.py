"""Beams that reach for targets: a vectorized environment of gymnasium, seen by a camera, and a policy that learns it.

Usage: python reach.py [--worlds 1024] [--seed 0] [--black] [--device cuda] [ADDRESS]

On an H200, 2,000 iterations take 100 s: the final distance is 0.03 m, that of random actions is 1.08 m.

Each world has a flexible beam and a small target. The policy sees a picture of 64 x 64 pixels and bends the beam, so
that its tip comes to the target. With `--device cuda`, neither pictures nor policy leave the GPU. `--black` trains the
same policy with black pictures, as a control. Needs gymnasium and torch. Without ADDRESS, it starts a server.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

import modalcast as mc

MODES = 4
LENGTH = 2.0  # meters
EPISODE = 8  # steps
REACH = 0.9  # largest |q|, which is a deflection in meters
STEP = 0.3  # largest change of a coordinate in a step
DISCOUNT = 0.7


def beam() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A vertical square tube: positions, faces, and U with two modes each that bend in x and z."""
    levels = np.linspace(0, 1, 17)
    corners = 0.09 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    positions = np.array([(x, LENGTH * level, z) for level in levels for x, z in corners])
    faces = [
        (len(positions) - 4, len(positions) - 2, len(positions) - 3),
        (len(positions) - 4, len(positions) - 1, len(positions) - 2),
    ]
    for first in range(0, len(positions) - 4, 4):
        for side in range(4):
            a, b = first + side, first + (side + 1) % 4
            faces += [(a, a + 4, b), (b, a + 4, b + 4)]
    U = np.zeros((len(positions), 3, MODES))
    height = positions[:, 1] / LENGTH
    for mode in range(MODES):
        shape = height**2 if mode < 2 else height**2 * (1.6 * height - 0.6)
        U[:, 2 * (mode % 2), mode] = shape
    return positions, np.array(faces), U.reshape(-1, MODES)


def octahedron(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and faces of the target."""
    positions = radius * np.vstack([np.eye(3), -np.eye(3)])
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    return positions, np.array(faces)


class BeamReach(VectorEnv):
    """Worlds in which the tip of a beam has to come to a target.

    An observation is a picture, 64 x 64 x 3 of uint8: an array of numpy or, with a device, a tensor of torch. An action
    changes the q of the beam, in units of `STEP`. The reward is minus the distance of tip and target in meters. All
    episodes end after `EPISODE` steps (truncated). `autoreset_mode` is DISABLED: reset with
    `options={"reset_mask": mask}`, which leaves other worlds as they are.
    """

    def __init__(self, client: mc.Client, worlds: int, *, device: str | None = None, black: bool = False) -> None:
        """Uploads the scene and opens the worlds. `black`: all observations are black."""
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED}
        self.num_envs = worlds
        self.single_observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (MODES,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, worlds)
        self.action_space = batch_space(self.single_action_space, worlds)
        builder = mc.SceneBuilder("reach").add(*beam(), name="beam", color=(0.1, 0.3, 0.7))
        builder.add(*octahedron(0.16), name="target", color=(0.9, 0.2, 0.05))
        scene = client.upload(builder, replace=True)
        camera = mc.look_at(eye=(0, 3.4, 4.6), target=(0, 1.5, 0), field_of_view=36)
        self._views = scene.views(camera, worlds=worlds, size=64, outputs="color", device=device, slots=12)
        self._device, self._black = device, black
        positions, _, U = beam()
        self._tip = positions[-4:].mean(axis=0)
        self._tip_modes = U.reshape(-1, 3, MODES)[-4:].mean(axis=0)
        self._q = np.zeros((worlds, MODES), np.float32)
        self._transforms = np.tile(np.eye(4, dtype=np.float32)[:3], (worlds, 2, 1, 1))
        self._steps = np.zeros(worlds, int)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Straightens the beams and moves the targets of all worlds, or of those in `reset_mask`."""
        super().reset(seed=seed)
        mask = np.ones(self.num_envs, bool) if options is None else options["reset_mask"]
        goal = self.np_random.uniform(-REACH, REACH, (mask.sum(), MODES)) * (1, 1, 0.4, 0.4)
        self._q[mask], self._steps[mask] = 0, 0
        self._transforms[mask, 1, :, 3] = self._tip + goal @ self._tip_modes.T
        return self._observe(), self._info()

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Bends the beams by actions, worlds x `MODES`."""
        self._q = np.clip(self._q + STEP * np.clip(actions, -1, 1), -REACH, REACH).astype(np.float32)
        self._steps += 1
        info = self._info()
        truncated = self._steps >= EPISODE
        return self._observe(), -info["distance"], np.zeros(self.num_envs, bool), truncated, info

    def close_extras(self, **_: Any) -> None:
        """Releases the worlds."""
        self._views.close()

    def _info(self) -> dict[str, Any]:
        tips = self._tip + self._q @ self._tip_modes.T
        return {"distance": np.linalg.norm(tips - self._transforms[:, 1, :, 3], axis=1)}

    def _observe(self) -> Any:
        pixels: Any = self._views.step(self._q, self._transforms)["color"]
        if self._device is not None:
            import torch

            pixels = torch.from_dlpack(pixels)
        return pixels * 0 if self._black else pixels


def train(env: BeamReach, iterations: int, seed: int, device: str, minutes: float) -> dict[str, float]:
    """Trains a policy by advantage actor-critic (Mnih et al. 2016) and evaluates it. Distances are in meters."""
    import torch
    from torch import nn

    torch.manual_seed(seed)
    layers = [nn.Conv2d(3, 32, 5, 2), nn.ReLU(), nn.Conv2d(32, 64, 3, 2), nn.ReLU(), nn.Conv2d(64, 64, 3, 2), nn.ReLU()]
    network = nn.Sequential(*layers, nn.Flatten(), nn.LazyLinear(256), nn.ReLU(), nn.Linear(256, MODES + 1)).to(device)

    def evaluate_network(pixels: Any) -> tuple[Any, Any]:
        images = torch.as_tensor(pixels, device=device).permute(0, 3, 1, 2).float() / 255 - 0.5
        output = network(images)
        return output[:, :MODES].tanh(), output[:, MODES]

    observation, _ = env.reset(seed=seed)
    evaluate_network(observation)  # sets the sizes of the layers
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.1, iterations)
    begin = time.perf_counter()
    for iteration in range(iterations):
        observation, _ = env.reset()
        deviation = 0.5 * (1 - iteration / iterations) + 0.1
        log_probabilities, values, rewards = [], [], []
        for _ in range(EPISODE):
            mean, value = evaluate_network(observation)
            policy = torch.distributions.Normal(mean, deviation)
            action = policy.sample()
            log_probabilities.append(policy.log_prob(action).sum(1))
            values.append(value)
            observation, reward, *_ = env.step(action.cpu().numpy())
            rewards.append(torch.as_tensor(reward, dtype=torch.float32, device=device))
        returns = torch.stack(rewards)
        for step in reversed(range(EPISODE - 1)):
            returns[step] += DISCOUNT * returns[step + 1]
        advantages = returns - torch.stack(values)
        weights = (advantages / (advantages.std(1, keepdim=True) + 1e-6)).detach()
        loss = -(torch.stack(log_probabilities) * weights).mean() + 0.5 * advantages.square().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if iteration % 50 == 0:
            print(f"iteration {iteration}: distance {-float(rewards[-1].mean()):.3f} m", flush=True)
        if time.perf_counter() - begin > 60 * minutes:
            break
    seconds = time.perf_counter() - begin

    def final_distance(act: Any) -> float:
        pixels, info = env.reset(seed=1000 + seed)
        for _ in range(EPISODE):
            pixels, _, _, _, info = env.step(act(pixels))
        return float(info["distance"].mean())

    with torch.no_grad():
        learned = final_distance(lambda pixels: evaluate_network(pixels)[0].cpu().numpy())
    random = np.random.default_rng(seed)
    return {
        "seconds": round(seconds, 1),
        "learned": round(learned, 3),
        "random": round(final_distance(lambda _: random.uniform(-1, 1, (env.num_envs, MODES))), 3),
        "still": round(final_distance(lambda _: np.zeros((env.num_envs, MODES))), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", nargs="?")
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--black", action="store_true")
    parser.add_argument("--device", choices=["cuda"])
    arguments = parser.parse_args()
    with mc.connect(arguments.address) if arguments.address else mc.spawn() as client:
        env = BeamReach(client, arguments.worlds, device=arguments.device, black=arguments.black)
        device = arguments.device or "cpu"
        result = train(env, arguments.iterations, arguments.seed, device, arguments.minutes)
        print(json.dumps({"seed": arguments.seed, "black": arguments.black, **result}))
        env.close()


if __name__ == "__main__":
    main()
