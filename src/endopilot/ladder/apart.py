"""A policy in a process of its own: `Apart` hands it observations, and takes decisions from it and nothing else."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from multiprocessing.connection import Connection
from typing import Any

from endopilot.errors import InputError
from endopilot.navigation.policies import make_policy
from endopilot.navigation.policy import Decision, Observation
from endopilot.plugins import described
from endopilot.tasks.navigation import Navigation


class Apart:
    """A policy that cannot reach the simulated world: it learns what a `NavigationLoop` hands out, and has to ask.

    Its answers come as text, so that they are decisions whatever it sends. It has a seed of its own: that of the
    navigation would tell it the errors of detection. It still has the files and the network of whoever runs it; a
    container takes these away.
    """

    def __init__(self, policy: str) -> None:
        """Start the process, which makes the policy of this name."""
        spawned = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawned.Pipe()
        self._process, self._name = spawned.Process(target=_serve, args=(policy, theirs), daemon=True), policy
        self._process.start()
        theirs.close()

    def __enter__(self) -> Apart:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()

    def start(self, navigation: Navigation, seed: int) -> None:
        """Let it prepare for a navigation."""
        self._ask("start", navigation, int(hashlib.sha256(f"policy {seed}".encode()).hexdigest()[:16], 16))

    def decide(self, observation: Observation) -> Decision:
        """Return what it decides, or raise `InputError` where it fails or decides something else."""
        try:
            said = self._ask("decide", observation)
            devices = tuple((float(v), float(w)) for v, w in said["devices"])
            return Decision(devices, expose=bool(said["expose"]), gives_up=str(said["gives_up"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"policy: {self._name!r} decided no velocities ({error}); return a Decision") from error

    def _ask(self, method: str, *given: Any) -> Any:
        try:
            self._pipe.send((method, given))
            said = json.loads(self._pipe.recv_bytes())
        except (EOFError, OSError) as error:
            raise InputError(f"policy: the process of {self._name!r} has ended; mend it") from error
        if "error" in said:
            raise InputError(str(said["error"]))
        return said


def _serve(name: str, pipe: Connection) -> None:
    """Make the policy and answer until the process ends."""
    policy = None
    while True:
        method, given = pipe.recv()
        try:
            policy = policy or make_policy(name)
            said = getattr(policy, method)(*given)
            answer = vars(said) if isinstance(said, Decision) else {}
            text = json.dumps(answer, default=float)
        except Exception as error:  # whatever it is, the other process is to name it
            text = json.dumps({"error": str(error) if isinstance(error, InputError) else described(error)})
        pipe.send_bytes(text.encode())
