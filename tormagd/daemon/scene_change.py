"""Changing the scene while the device is disabled: a new core is built beside the beats, then replaces the old one."""

import asyncio
import logging
from collections.abc import Awaitable, Callable

from tormagd.control.assembly.build import Core
from tormagd.control.safety.operating_state import RefusedError
from tormagd_client.endpoints import ConfigError
from tormagd_client.messages import Explained, SceneReport

LONGEST_NAME = 4_096
NEXT = (
    "name a scene that tormagctl scene check takes, as each of tormagctl scene list; rates stay: state [rates], or "
    "start with that scene"
)

log = logging.getLogger(__name__)


class SceneChange:
    """Changes the running scene, one change at a time; `newest` reports on the newest change."""

    def __init__(
        self, build: Callable[[str], Awaitable[Core]], require: Callable[[], None], take: Callable[[str, Core], None]
    ) -> None:
        self._build, self._require, self._take = build, require, take
        self.newest: SceneReport | None = None
        self._changing: asyncio.Task[None] | None = None

    def begin(self, scene: object) -> None:
        if not isinstance(scene, str) or not 0 < len(scene) <= LONGEST_NAME:
            raise RefusedError(
                "bad_scene", f"args.scene is no text of 1..{LONGEST_NAME} characters", "tormagctl scene list"
            )
        if self._changing is not None and not self._changing.done():
            raise RefusedError("busy", "another scene is being made ready", "tormagctl status")
        self._require()
        self.newest = SceneReport(scene=scene, is_over=False)
        self._changing = asyncio.get_running_loop().create_task(self._change(scene))
        # an unexpected error is reported at once, not when the task is collected
        self._changing.add_done_callback(asyncio.Task.result)

    async def _change(self, scene: str) -> None:
        error = None
        try:
            core = await self._build(scene)
            self._require()
            self._take(scene, core)
        except ConfigError as refused:
            error = Explained("bad_scene", str(refused), NEXT)
        except RefusedError as refused:
            error = Explained(refused.code, refused.message, refused.hint)
        if error is None:
            log.info("the scene is now %s", scene)
        else:
            log.warning("the scene stays as it was: %s; next: %s", error.cause, error.remedy)
        self.newest = SceneReport(scene=scene, is_over=True, error=error)
