"""A LeRobot dataset with the columns, episode hooks and durability of this project.

`XopDataset` behaves like `LeRobotDataset` in LeRobot's loops: while recording, `features` lists
only LeRobot's own columns. The additional data come from the session that robot and teleoperator
share (`xop_lerobot.session`), so the loops need not know about them.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping, MutableMapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self, cast

from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HOME

from xop_lerobot.core.errors import BadValue, LinkError, XopError
from xop_lerobot.core.shutdown import hold_signals
from xop_lerobot.core.state import RobotState
from xop_lerobot.operator.display import Cue, Progress, RecordingRequest
from xop_lerobot.recording import writer
from xop_lerobot.recording.columns import Columns, has_all_columns, is_own_column
from xop_lerobot.recording.executed import put_executed
from xop_lerobot.recording.facts import (
    FACT_COLUMNS,
    FACTS_PREFIX,
    EpisodeFacts,
    append_facts,
    compute_config_hash,
    gather_facts,
    keep_config,
    to_plain,
)
from xop_lerobot.recording.lerobot_patches import (
    DATASET,
    EPISODE_METADATA,
    ROLLBACK,
    ROTATION,
    Patched,
    fits,
    get_stock,
)
from xop_lerobot.recording.opening import (
    DatasetExists,
    NotMade,
    WrongFps,
    check_encoding,
    check_resumable,
    find_unreadable,
)
from xop_lerobot.recording.requests import EpisodeCounts, grant
from xop_lerobot.recording.rollback import (
    check_pictures,
    find_reason,
    raise_if_not_written,
    rolled_back_on_failure,
)
from xop_lerobot.recording.writer import VideoQueue, keep_schedule, skip_embedding
from xop_lerobot.session import RobotInfo, Session, Tick, get_session

logger = logging.getLogger(__name__)


class XopDataset(LeRobotDataset):
    """LeRobotDataset with additional columns on operator, goal, retargeter and robot.

    Attributes:
        session_name: Session to record.
        extra_columns: Whether to record the columns of `xop_lerobot.recording.columns`.
        more_facts: Metadata of the next episode known only to the caller, as plain values for JSON.
    """

    session_name: ClassVar[str] = "default"
    extra_columns: ClassVar[bool] = True
    more_facts: Mapping[str, Any] = MappingProxyType({})

    _session: Session
    _info: RobotInfo
    _columns: Columns | None
    _config: dict[str, Any]
    _config_hash: str
    _keep_facts: bool
    _own_root: bool
    _create_options: dict[str, Any]

    @classmethod
    def bind(cls, session: str, *, extra_columns: bool = True) -> type[Self]:
        """Return this class for the session `session`."""
        names = {"session_name": session, "extra_columns": extra_columns}
        bound = type(cls.__name__, (cls,), {**names, "__doc__": cls.__doc__})
        return cast("type[Self]", bound)

    @classmethod
    def create(  # pyright: ignore[reportIncompatibleMethodOverride]
        cls, repo_id: str, fps: int, features: dict, root: str | Path | None = None, **options: Any
    ) -> Self:
        """Create a dataset; see `LeRobotDataset.create` for the arguments.

        Raises:
            LinkError: If the session has no robot, or more than one.
            LeRobotMisfit: If LeRobot has changed so that an episode would lack something.
            WrongFps: If the robot runs at another rate.
            BatchedEncoding: If videos would be encoded after their episodes are saved.
            DatasetExists: If the directory already exists.
            NotMade: If the directory cannot be created.
        """
        info = get_session(cls.session_name).robot
        fits(DATASET)
        check_encoding(options)
        if fps != info.fps:
            raise WrongFps(info.fps, fps)
        folder = Path(root) if root else HF_LEROBOT_HOME / repo_id
        if folder.exists():
            raise DatasetExists(folder)
        columns = Columns(info) if cls.extra_columns else None
        features = {**features, **(columns.features if columns else {})}
        try:
            dataset = cast("Self", super().create(repo_id, fps, features, root=root, **options))
        except FileExistsError as error:  # created meanwhile by another process
            raise DatasetExists(folder) from error
        except OSError as error:
            shutil.rmtree(folder, ignore_errors=True)
            raise NotMade(folder, find_reason(error)) from error
        dataset._begin_session(info, columns, options)
        dataset._own_root = True
        return dataset

    @classmethod
    def resume(  # pyright: ignore[reportIncompatibleMethodOverride]
        cls, repo_id: str, root: str | Path | None = None, **options: Any
    ) -> Self:
        """Open a dataset to add episodes; see `LeRobotDataset.resume` for the arguments.

        A dataset that was recorded without this project's columns stays without them.

        Raises:
            LinkError: If the session has no robot, or more than one.
            LeRobotMisfit: If LeRobot has changed so that an episode would lack something.
            BatchedEncoding: If videos would be encoded after their episodes are saved.
            BadDataset: If there is no dataset, or it cannot be read.
            NotResumable: If it is of another robot, or has other cameras or image sizes.
            WrongFps: If the robot runs at another rate.
            BadValue: If its columns are those of another version of this project.
        """
        info = get_session(cls.session_name).robot
        fits(DATASET)
        check_encoding(options)
        dataset = cls._open(repo_id, root, options)
        try:
            columns = dataset._check_fit(info)
        except BaseException:
            LeRobotDataset.finalize(dataset)
            raise
        if columns is None and cls.extra_columns:
            logger.warning(
                "'%s' was recorded without the operator's columns; new episodes have none either.",
                dataset.root,
            )
        dataset._begin_session(info, columns, options)
        episodes = dataset.meta.episodes
        if episodes is not None and len(episodes) > 0:
            dataset._keep_facts = set(FACT_COLUMNS) <= set(episodes.column_names)
        return dataset

    @classmethod
    def _open(cls, repo_id: str, root: str | Path | None, options: dict[str, Any]) -> Self:
        """Open a dataset to resume it; see `resume`."""
        if not root:
            raise BadValue("--resume=true needs --dataset.root, the directory of the dataset")
        folder = Path(root)
        existed = folder.exists()
        try:
            return cast("Self", super().resume(repo_id, root=root, **options))
        except Exception as error:  # LeRobot raises errors of JSON, Parquet and the Hub
            unreadable = find_unreadable(folder, repo_id, error)
            if not existed:
                with suppress(OSError):
                    folder.rmdir()  # created by LeRobot
            raise unreadable from error

    def _check_fit(self, info: RobotInfo) -> Columns | None:
        """Check that the robot's episodes match; return our columns, None if there are none."""
        if self.fps != info.fps:
            raise WrongFps(info.fps, self.fps)
        columns, features = Columns(info), self.meta.features
        check_resumable(self.root, self.meta.robot_type, features, info, columns.features)
        return columns if has_all_columns(features, columns, self.root) else None

    def _begin_session(
        self, info: RobotInfo, columns: Columns | None, options: dict[str, Any]
    ) -> None:
        self._session = get_session(self.session_name)
        self._info, self._columns = info, columns
        self._create_options = options
        self._keep_facts, self._own_root = True, False
        self._counts = EpisodeCounts()
        self._tick_limit: int | None = None
        self._stop_on_success = self._paused = False
        self._events: MutableMapping[str, bool] = {}
        self._last_state: RobotState | None = None
        # Written with the first saved episode, so that a session without one changes nothing.
        self._config = to_plain(self._session.configs)
        self._config_hash = compute_config_hash(self._config)
        self._attach_writer()
        self._session.begin_episode(self.num_episodes)

    def _attach_writer(self) -> None:
        self._video = VideoQueue(getattr(self.writer, "_streaming_encoder", None), self.writer)
        fits(ROLLBACK)  # warn now, not only when the disk is full
        self._patched = Patched()
        if fits(EPISODE_METADATA):
            stock = get_stock(EPISODE_METADATA, self.meta)
            # Patched on the instance, so that other datasets of the process are not affected.
            self._patched.put(EPISODE_METADATA, self._add_facts(stock), self.meta)

    def _add_facts(self, stock: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(stock)

        def save_with_facts(*args: Any, **kwargs: Any) -> None:
            """Save an episode's metadata, with what is known of it as a whole."""
            call = signature.bind(*args, **kwargs)
            if self._keep_facts:
                metadata = {**call.arguments["episode_metadata"]}
                metadata |= self._collect_facts().to_metadata()
                for key, value in self.more_facts.items():
                    metadata[FACTS_PREFIX + key] = json.dumps(value)
                call.arguments["episode_metadata"] = metadata
            stock(*call.args, **call.kwargs)

        return save_with_facts

    def __bool__(self) -> bool:
        """True even while empty, since `lerobot-record` finalizes its dataset only `if dataset`."""
        return True

    # Episode methods, in the order in which LeRobot's loops call them.

    @property
    def features(self) -> dict[str, dict]:
        """All features; while recording, only those that LeRobot's loops fill."""
        features = self.meta.features
        if self.writer is None or self._is_finalized:
            return features
        return {key: value for key, value in features.items() if not is_own_column(key)}

    def begin(
        self,
        events: MutableMapping[str, bool],
        tick_limit: int | None,
        *,
        stop_on_success: bool = False,
    ) -> None:
        """Start an episode, and define when it ends.

        Args:
            events: The loop's events; `exit_early` is set when the episode is over.
            tick_limit: Number of frames after which it is over, None to leave that to the loop.
            stop_on_success: Whether it ends as soon as the task is accomplished.
        """
        self._events, self._tick_limit = events, tick_limit
        self._stop_on_success, self._paused = stop_on_success, False
        self._session.recorder = self
        self.forget_presses()

    def forget_presses(self) -> None:
        """Discard key presses from before the first frame of the episode.

        Saving and resetting take a second without visible progress, so people press again, meaning
        the previous episode. Only Esc still counts: it ends the session, and an episode without
        frames is left out.
        """
        if self._counts.frames or not self._events:
            return
        stops = self._events.get("stop_recording", False)
        self._events["exit_early"] = self._events["rerecord_episode"] = stops

    def pause(self, events: MutableMapping[str, bool]) -> None:
        """Start the pause after an episode, during which it can still be discarded."""
        self._events, self._paused = events, True
        progress = self._session.progress
        if progress is not None:
            self._session.progress = dataclasses.replace(progress, paused=True)

    def grant(self, request: RecordingRequest) -> tuple[Cue, str]:
        """Fulfil a request of the operator; return the notice for the operator."""
        tick = self._session.tick
        time = 0.0 if tick is None else tick.state.time
        told = grant(request, self._events, self._counts, paused=self._paused, time=time)
        progress = self._session.progress
        if progress is not None:
            self._session.progress = dataclasses.replace(progress, success=self._counts.success)
        return told

    def add_frame(self, frame: dict) -> None:
        """Add a frame with this tick's extra columns and the executed action.

        Raises:
            LinkError: If the robot was not observed before the frame, or has not executed an
                action.
            BadValue: If the frame belongs to an earlier tick, whose columns are gone.
            NotSaved: If it cannot be written, usually because the disk is full.
        """
        counts, tick = self._counts, self._session.tick
        frame = put_executed(frame, tick, self.meta.features)
        if self._columns is not None:
            frame = {**frame, **self._columns.build_row(self._check_order(tick))}
        if not self._info.realtime:
            self._video.wait()
        self._video.wait_for_images()
        counts.task = str(frame["task"])
        try:
            super().add_frame(frame)
        except Exception as error:
            raise_if_not_written(self, error)
            raise
        if tick is not None:
            counts.note_state(tick.state)
            counts.note_changes(tick)
            counts.driven |= tick.engaged

        counts.last = time.perf_counter()
        if counts.frames == 0:
            counts.first, counts.start_time = counts.last, time.time()
        counts.frames += 1
        outcome = None if tick is None else tick.outcome
        counts.success = outcome is not None and outcome.success
        if counts.marked is not None:
            counts.success = counts.marked
        counts.finished = tick is not None and tick.finished
        is_over = counts.finished or counts.frames == self._tick_limit
        if is_over or (self._stop_on_success and counts.success):
            self._events["exit_early"] = True
        length = counts.frames / self.fps
        self._session.progress = Progress(self.num_episodes, counts.frames, length, counts.success)

    def _check_order(self, tick: Tick | None) -> Tick:
        """Check that a frame of `tick` can be recorded now; see `add_frame`."""
        if tick is None or tick.executed is None:
            missing = "get_observation()" if tick is None else "send_action()"
            raise LinkError(
                f"a frame came before its tick was complete: call {missing} of {self._info.name} "
                f"in session '{self._session.name}' before each add_frame()"
            )
        if tick.state is self._last_state:
            raise BadValue(
                "a frame came late: another one of the same tick is recorded already. "
                "--strategy.type=highlight keeps frames back, and their columns are gone then; "
                "use another strategy, or --teleop.record.columns=false"
            )
        self._last_state = tick.state
        return tick

    def save_episode(
        self, episode_data: dict | None = None, parallel_encoding: bool = True
    ) -> None:
        """Save the episode durably, and request a reset of the robot.

        An episode without frames is not saved. If saving fails, the dataset is restored to its
        previous state and closed.

        Raises:
            NotSaved: If the episode cannot be written, usually because the disk is full.
            XopError: If video frames were lost in lock-step.
        """
        if episode_data is None and not self.has_pending_frames():
            # Without events no episode was begun: LeRobot's rollouts save once more at their end.
            if self._events:
                logger.warning("Episode %d has no frame; it is not saved.", self.num_episodes)
            return
        facts, index = self._collect_facts(), self.num_episodes
        if not self._info.realtime and facts.dropped_frames:
            raise XopError(
                f"episode {index} lost {facts.dropped_frames} video frames; it is not saved"
            )
        length = self._counts.frames
        self._counts.write_mark(episode_data or (self.writer.episode_buffer if self.writer else {}))
        with hold_signals(), skip_embedding(self), keep_schedule(), rolled_back_on_failure(self):
            check_pictures(self, index)
            super().save_episode(episode_data, parallel_encoding)
            self._secure()
            keep_config(self.root, self._config)
            append_facts(self.root, index, length, facts, self.more_facts)
            self._own_root = False
        if facts.dropped_frames or facts.late:
            logger.warning(
                "Episode %d dropped %d video frames and ran at %.1f Hz of %d; it is marked so.",
                index,
                facts.dropped_frames,
                facts.real_fps,
                self.fps,
            )
        self._begin_next(index + 1)

    def clear_episode_buffer(self, delete_images: bool = True) -> None:
        """Discard the episode and request a reset of the robot."""
        super().clear_episode_buffer(delete_images)
        self._begin_next(self.num_episodes)

    def finalize(self) -> None:
        """Close all files; a new dataset without episodes is removed again."""
        if self._is_finalized:
            return
        super().finalize()
        self._patched.undo()
        self._session.progress = None
        if self._session.recorder is self:
            self._session.recorder = None
        writer.forget_rotation(self)
        if self._own_root and self.num_episodes == 0:
            shutil.rmtree(self.root, ignore_errors=True)

    def _begin_next(self, index: int) -> None:
        self._counts, self._events = EpisodeCounts(), {}
        self._session.progress = None
        self._session.begin_episode(index)

    def _secure(self) -> None:
        """Close the files of the saved episode; the next episode opens new ones."""
        if fits(ROTATION):
            writer.rotate_writers(self)
            return
        self._patched.undo()
        LeRobotDataset.finalize(self)
        known = inspect.signature(LeRobotDataset.resume).parameters
        options = {key: value for key, value in self._create_options.items() if key in known}
        fresh = super().resume(self.repo_id, root=self.root, **options)
        self.__dict__.update(vars(fresh))  # LeRobot's attributes alone
        # The writer belongs to `self` now; `fresh` must not close it when garbage-collected.
        fresh.writer = None
        self._attach_writer()

    def _collect_facts(self) -> EpisodeFacts:
        return gather_facts(self._counts, self._info, self._config_hash, self._video.dropped)
