"""Every patch of LeRobot: what this project replaces in it, or reads of its private parts.

Compare this file with LeRobot's release notes. `PATCHES` lists each patched place with what is
expected there, its purpose, and the change in LeRobot that would make it unnecessary. Plain imports
are not listed: if one is gone, Python raises an error.

Each patch is checked before use (`fits`), and `xop-doctor` checks all. If data would be wrong or
incomplete without it, a misfit is an error; otherwise a warning says what is lost.

Made for LeRobot 0.6.1. The loops of its main branch (`7427f318`, 2026-11-30), which take a `timer`
and no `fps`, fit too.
"""

from __future__ import annotations

import dis
import importlib
import importlib.metadata
import inspect
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

from xop_lerobot.core.errors import XopError

logger = logging.getLogger(__name__)

MADE_FOR = "0.6.1"
"""Version of LeRobot that this project is released with."""


class Use(Enum):
    """How a part of LeRobot is patched or used."""

    REPLACED = "an object of this project has its name"
    WRAPPED = "a function of this project has its name, and calls it"
    SUBCLASSED = "a class overrides its methods, whose first parameters must keep their order"
    READ = "attributes are read or set that LeRobot does not document"


@dataclass(frozen=True)
class Patch:
    """A part of LeRobot that this project uses beyond its documented interface.

    Attributes:
        name: Name in messages.
        use: How it is used.
        expects: Requirements by place: `module:function()` with parameter names, or `module:class`
            with attribute names. The first place is what is replaced. Empty if a misfit is obvious
            by itself.
        purpose: Purpose.
        waits_for: Change in LeRobot that would make it unnecessary.
        without: Consequence of a misfit and what to do; a sentence or two.
        required: Whether recording is refused without it.
    """

    name: str
    use: Use
    expects: Mapping[str, tuple[str, ...]]
    purpose: str
    waits_for: str
    without: str
    required: bool = False


RECORD_MODULE = "lerobot.scripts.lerobot_record"
ROLLOUT_MODULE = "lerobot.scripts.lerobot_rollout"
CONTEXT_MODULE = "lerobot.rollout.context"
_COMMANDS = {
    RECORD_MODULE: "lerobot-record",
    ROLLOUT_MODULE: "lerobot-rollout",
    CONTEXT_MODULE: "lerobot-rollout",
}

_WRITER = "lerobot.datasets.dataset_writer:DatasetWriter"
_METADATA = "lerobot.datasets.dataset_metadata:LeRobotDatasetMetadata"
_ENCODER = "lerobot.datasets.video_utils:StreamingVideoEncoder"
_STRATEGY = "lerobot.rollout.strategies.episodic:EpisodicStrategy"

DATASET = Patch(
    "subclass of LeRobotDataset",
    Use.SUBCLASSED,
    {
        "lerobot.datasets:LeRobotDataset": ("_is_finalized", "writer", "meta"),
        "lerobot.datasets:LeRobotDataset.create()": ("repo_id", "fps", "features", "root"),
        "lerobot.datasets:LeRobotDataset.resume()": ("repo_id", "root"),
        "lerobot.datasets:LeRobotDataset.add_frame()": ("frame",),
        "lerobot.datasets:LeRobotDataset.save_episode()": ("episode_data", "parallel_encoding"),
        "lerobot.datasets:LeRobotDataset.clear_episode_buffer()": ("delete_images",),
        "lerobot.datasets:LeRobotDataset.finalize()": (),
    },
    purpose="XopDataset adds columns, episode metadata and files that survive a killed process.",
    waits_for="hooks for more columns and for the boundaries of episodes",
    without=f"Nothing can be recorded. Install LeRobot {MADE_FOR}, or a newer xop-lerobot.",
    required=True,  # every command records through this class
)
RECORD_DATASET = Patch(
    "dataset of lerobot-record",
    Use.REPLACED,
    {f"{RECORD_MODULE}:LeRobotDataset": ()},
    purpose="lerobot-record makes an XopDataset.",
    waits_for="a choice of columns, or of the dataset's class, on LeRobot's command line",
    without="lerobot-record cannot record the operator's columns. Use xop-record, which takes the "
    "same flags.",
    required=True,  # what a person has driven cannot be given the columns afterwards
)
RECORD_LOOP = Patch(
    "loop of lerobot-record",
    Use.WRAPPED,
    {f"{RECORD_MODULE}:record_loop()": ("robot", "events", "dataset", "control_time_s")},
    purpose="An episode in lock-step ends by its number of frames, and any episode by gestures.",
    waits_for="an episode length in frames, and hooks for the boundaries of episodes",
    without="In lerobot-record an episode in lock-step would end by the wall clock, and gestures "
    "would not end any. Use xop-record, which takes the same flags.",
    required=True,  # the same command would give other episodes on another machine
)
CONTEXT_DATASET = Patch(
    "dataset of lerobot-rollout",
    Use.REPLACED,
    {f"{CONTEXT_MODULE}:LeRobotDataset": ()},
    purpose="lerobot-rollout makes an XopDataset.",
    waits_for="a choice of columns, or of the dataset's class, on LeRobot's command line",
    # A policy can run again, and no other command records one.
    without="lerobot-rollout records LeRobot's columns alone, and an episode in lock-step ends by "
    "the wall clock.",
)
POLICY_LOOP = Patch(
    "loop of lerobot-rollout",
    Use.WRAPPED,
    {
        f"{_STRATEGY}._policy_loop()": ("events", "dataset", "control_time_s"),
        _STRATEGY: ("_interpolator",),
        "lerobot.utils.action_interpolator:ActionInterpolator": ("multiplier",),
    },
    purpose="An episode in lock-step ends by its number of frames, with one action a frame.",
    waits_for="#4559 (merged after 0.6.1): plugins may bring a strategy, `lerobot_strategy_...`",
    # The rows are right all the same.
    without="In lerobot-rollout an episode in lock-step ends by the wall clock: its length depends "
    "on the machine.",
)
ROLLOUT_PICTURES = Patch(
    "set-up of lerobot-rollout",
    Use.WRAPPED,
    {f"{ROLLOUT_MODULE}:build_rollout_context()": ("cfg",)},
    purpose="A policy that was trained with images of another size is refused.",
    waits_for="a comparison of sizes, and not only of names, in LeRobot",
    # It only refuses what is wrong.
    without="Nobody compares the size of a policy's images with the robot's: compare "
    "--robot.width and --robot.height yourself.",
)
EPISODE_METADATA = Patch(
    "metadata of an episode",
    Use.WRAPPED,  # on the one instance of a dataset that is recorded
    {f"{_METADATA}.save_episode()": ("episode_metadata",)},
    purpose="This project's episode metadata is also in LeRobot's own.",
    waits_for="#2999: metadata for each episode",
    # They are written twice.
    without="Episode metadata is only in meta/xop/episodes.jsonl, where `xop-curate` reads it.",
)
ROTATION = Patch(
    "files of an episode",
    Use.READ,
    {
        _WRITER: ("_pq_writer", "_latest_episode", "close_writer"),
        _METADATA: ("_pq_writer", "_close_writer", "latest_episode", "episodes"),
    },
    purpose="The files of an episode are closed when it is saved, so a killed process loses none.",
    waits_for="#2495, #3522, PR #3631: episodes that survive a crash",
    # The public way does the same.
    without="Each save closes and opens the whole dataset instead, which takes up to seconds.",
)
ROLLBACK = Patch(
    "save that failed",
    Use.READ,
    {
        _WRITER: (
            "_pq_writer",
            "_finalized",
            "episode_buffer",
            "image_writer",
            "stop_image_writer",
            "cancel_pending_videos",
        ),
        _METADATA: ("_pq_writer", "_finalized", "_metadata_buffer"),
    },  # fmt: skip
    purpose="An episode that cannot be written, as on a full disk, leaves the dataset as it was.",
    waits_for="a save in LeRobot that takes back what it began",
    # It concerns saves that fail, and those can be repaired.
    without="If an episode cannot be saved, the dataset may be left unreadable: `xop-curate "
    "repair` restores what is complete.",
)
ENCODER = Patch(
    "queues of the video encoder",
    Use.READ,
    {
        _ENCODER: ("_frame_queues", "_threads", "_dropped_frames"),
        _WRITER: ("_streaming_encoder",),
    },
    purpose="In lock-step recording waits for the encoder; in real time lost frames are counted.",
    waits_for="PR #4462: no frame is dropped offline",
    without="Frames of a video could be lost without a sign, and its images then belong to other "
    "rows. Use --dataset.streaming_encoding=false.",
    required=True,  # nothing in such a dataset shows that its images are wrong
)
IMAGES = Patch(
    "queue of the image writer",
    Use.READ,
    {"lerobot.datasets.image_writer:AsyncImageWriter": ("queue", "threads", "processes")},
    purpose="Recording waits while many images wait for a slow disk.",
    waits_for="a queue with an end in LeRobot's image writer",
    # Most disks are fast enough.
    without="Where a disk is slower than the cameras, images fill the memory. Use "
    "--dataset.streaming_encoding=true.",
)
EMBEDDING = Patch(
    "embed_images",
    Use.REPLACED,  # while an episode is saved
    {"lerobot.datasets.dataset_writer:embed_images()": ("dataset",)},
    purpose="No pass over every row where there is no image to embed: 5 to 10 ms a frame.",
    waits_for="a save in LeRobot that skips it without image columns",
    without="Saving an episode takes some seconds longer.",
)
MERGE_EPISODES = Patch(
    "load_episodes",
    Use.REPLACED,  # while xop-collect merges
    {"lerobot.datasets.dataset_metadata:load_episodes()": ("local_dir",)},
    purpose="Single episodes are merged without a second for the 900 columns of each.",
    waits_for="a faster reader of episode metadata in LeRobot",
    without="Merging takes about a second more for each episode.",
)
MERGE_BARS = Patch(
    "bars of aggregate_datasets",
    Use.REPLACED,  # while xop-collect merges
    {"lerobot.datasets.aggregate:tqdm": ("tqdm",)},
    purpose="LeRobot's progress bars are not among the command's own lines.",
    waits_for="a switch for the bars in LeRobot",
    without="LeRobot's progress bars show among the command's lines.",
)
SLOW_TICKS = Patch(
    "warning of slow ticks",
    Use.READ,
    {},  # if LeRobot words it otherwise, it shows
    purpose="A slow tick in lock-step is not warned of: none is wrong, only later.",
    waits_for="a loop in LeRobot on the robot's clock",
    without="LeRobot warns of each slow tick in lock-step.",
)
SLOW_TICK_TEXT = "loop is running slower"
"""Part of that warning's text: "Record loop" in 0.6.1, "Control loop" later."""
SLOW_TICK_LOGGERS = (None, "lerobot.rollout.strategies.episodic", "lerobot.utils.cycle_timer")
"""Loggers that may emit it, by LeRobot's version and command; None is the root logger."""

PATCHES = (
    DATASET, RECORD_DATASET, RECORD_LOOP, CONTEXT_DATASET, POLICY_LOOP, ROLLOUT_PICTURES,
    EPISODE_METADATA, ROTATION, ROLLBACK, ENCODER, IMAGES, EMBEDDING, MERGE_EPISODES, MERGE_BARS,
    SLOW_TICKS,
)  # fmt: skip


class LeRobotMisfit(XopError):
    """LeRobot does not fit a patch without which recording is refused."""


def fits(patch: Patch) -> bool:
    """Whether LeRobot fits `patch`; each misfit is logged once per process.

    Raises:
        LeRobotMisfit: If it does not, and the patch is required.
    """
    text = find_misfit(patch)
    if text and patch.required:
        raise LeRobotMisfit(text)
    if text and text not in _said:
        _said.add(text)
        logger.warning("%s", text)
    return not text


_said: set[str] = set()


def find_misfit(patch: Patch) -> str:
    """Describe how LeRobot does not fit `patch`, and the consequence; empty if it fits."""
    faults = [_find_fault(patch.use, place, names) for place, names in patch.expects.items()]
    fault = "; ".join(filter(None, faults))
    if not fault:
        return ""
    version = importlib.metadata.version("lerobot")
    return (
        f"LeRobot {version} does not fit the patch '{patch.name}', made for {MADE_FOR}: "
        f"{fault}. {patch.without}"
    )


def _find_fault(use: Use, place: str, names: tuple[str, ...]) -> str:
    label = place.replace(":", ".")
    try:
        owner, name = _find_owner(place)
    except (ImportError, AttributeError) as error:
        return f"{label} is expected, and {error}"
    found = getattr(owner, name)
    if place.endswith("()"):
        taken = _list_parameters(found)
        fit = taken[: len(names)] == names if use is Use.SUBCLASSED else set(names) <= set(taken)
        if not fit:
            return f"{label} must take {', '.join(names)}, and takes {', '.join(taken) or 'none'}"
    elif missing := [each for each in names if not _has(found, each)]:
        return f"{label} must have {', '.join(names)}, and has no {', '.join(missing)}"
    return ""


def _find_owner(place: str) -> tuple[Any, str]:
    """Return the object that holds `module:Class.method()`, and the last name.

    Raises:
        ImportError: If there is no such module.
        AttributeError: If a name in it does not exist.
    """
    module, _, path = place.removesuffix("()").partition(":")
    label, names = module, path.split(".")
    owner, found = None, find(module) or importlib.import_module(module)
    for name in names:
        owner, found = found, getattr(found, name, None)
        if found is None:
            raise AttributeError(f"{label} has no {name}")
        label = f"{label}.{name}"
    return owner, names[-1]


def _list_parameters(function: Callable[..., Any]) -> tuple[str, ...]:
    names = tuple(get_signature(function).parameters)
    return names[1:] if names[:1] == ("self",) else names


def get_signature(function: Callable[..., Any]) -> inspect.Signature:
    """Return the signature of LeRobot's own function, below our patch and LeRobot's decorators."""
    inner = getattr(function, "xop_stock", function)
    if inspect.isfunction(inner):
        # LeRobot's `safe_stop_image_writer` hides the loop in a closure.
        inner = inspect.getclosurevars(inner).nonlocals.get("func", inner)
    return inspect.signature(inner)


def _has(owner: Any, name: str) -> bool:
    """Whether `owner` has an attribute, or is a class with a method that sets it."""
    if hasattr(owner, name):
        return True
    kinds = owner.__mro__ if isinstance(owner, type) else ()
    return any(name in _list_set(member) for kind in kinds for member in vars(kind).values())


def _list_set(member: Any) -> set[str]:
    """List the attributes that a method assigns, on any object."""
    function = getattr(member, "__func__", member)
    if not isinstance(function, FunctionType):
        return set()
    steps = dis.get_instructions(function)
    return {step.argval for step in steps if step.opname == "STORE_ATTR"}


def find(name: str) -> ModuleType | None:
    """Return LeRobot's module `name` if it is loaded, also as the main program."""
    main = sys.modules.get("__main__")
    if main is not None and getattr(getattr(main, "__spec__", None), "name", None) == name:
        return main
    return sys.modules.get(name)


def runs(module: str) -> bool:
    """Whether the LeRobot command that uses `module` is running, by loaded modules or program name.

    The program name also detects a command whose module LeRobot has moved.
    """
    program = Path(sys.argv[0]).stem if sys.argv else ""
    return find(module) is not None or program == _COMMANDS[module]


class _Replaced(NamedTuple):
    owner: Any
    name: str
    stock: Any
    ours: Any
    own: bool
    """Whether `owner` itself had the name, not a base class."""


class Patched:
    """A set of replaced objects of LeRobot, restored together."""

    def __init__(self) -> None:
        self._replaced: list[_Replaced] = []

    def put(self, patch: Patch, ours: Any, owner: Any = None) -> None:
        """Install `ours` at the place of `patch`, which must fit.

        Args:
            patch: A patch whose use is replacing or wrapping.
            ours: The replacement; it gets an attribute `xop_stock`.
            owner: The single instance to patch, None for all of LeRobot.
        """
        owner, name = _locate(patch, owner)
        stock = get_stock(patch, owner)
        ours.xop_stock = stock
        self._replaced.append(_Replaced(owner, name, stock, ours, name in vars(owner)))
        setattr(owner, name, ours)

    def undo(self) -> None:
        """Restore LeRobot's objects, except where patched again since; may be called twice."""
        for each in reversed(self._replaced):
            if getattr(each.owner, each.name) is not each.ours:
                continue
            if each.own:
                setattr(each.owner, each.name, each.stock)
            else:
                delattr(each.owner, each.name)
        self._replaced.clear()


def get_stock(patch: Patch, owner: Any = None) -> Any:
    """Return LeRobot's own object at the place of `patch`, also if it is patched."""
    current = getattr(*_locate(patch, owner))
    return getattr(current, "xop_stock", current)


def is_patched(patch: Patch) -> bool:
    """Whether the place of `patch` is patched."""
    return hasattr(getattr(*_locate(patch)), "xop_stock")


def _locate(patch: Patch, owner: Any = None) -> tuple[Any, str]:
    """Return the owner of the replaced object (or the given instance), and its name."""
    place, name = _find_owner(next(iter(patch.expects)))
    return (place if owner is None else owner), name


@contextmanager
def replaced(patch: Patch, ours: Any) -> Iterator[None]:
    """Within the block, install `ours` at the place of `patch`, if it fits."""
    patched = Patched()
    if fits(patch):
        patched.put(patch, ours)
    try:
        yield
    finally:
        patched.undo()
