"""Videos that are damaged inside: found by their packets' framing, and never passed on."""

from __future__ import annotations

import shutil
from pathlib import Path

import av
import numpy as np
import pytest
from curate_data import compute_digests
from curate_recorded import make_packed
from hypothesis import given
from hypothesis import strategies as st
from lerobot.datasets import LeRobotDataset
from lerobot_rows import get_row

from xop_lerobot.curate.cli import main
from xop_lerobot.curate.video import index_video, is_whole_av1, is_whole_nal

LENGTHS = (37, 25, 44)
CODECS = {"h264": {"vcodec": "h264", "preset": "ultrafast"}, "hevc": {"vcodec": "hevc"}, "av1": {}}


@pytest.fixture(scope="module", params=CODECS)
def packed(request, tmp_path_factory) -> Path:
    """Three episodes in one video."""
    root = tmp_path_factory.mktemp("packed") / request.param
    make_packed(root, LENGTHS, **CODECS[request.param])
    return root


def find_video(root: Path) -> Path:
    (video,) = root.glob("videos/*/*/*.mp4")
    return video


def find_packets(video: Path) -> list[tuple[int, int]]:
    """Place and size of each packet in the file."""
    packets = []
    with av.open(str(video)) as container:
        for packet in container.demux(container.streams.video[0]):
            if packet.pts is not None:
                assert packet.pos is not None
                packets.append((packet.pos, packet.size))
    return packets


@pytest.fixture
def damaged(packed, tmp_path) -> Path:
    """The same, with a block of zeros over a picture in the middle of episode 1."""
    root = tmp_path / "damaged"
    shutil.copytree(packed, root)
    video = find_video(root)
    place, size = find_packets(video)[LENGTHS[0] + 12]
    content = bytearray(video.read_bytes())
    content[place : place + size] = bytes(size)
    video.write_bytes(content)
    return root


@pytest.mark.slow
def test_whole_videos_are_whole(packed):
    video = find_video(packed)
    index = index_video(packed, video.relative_to(packed))
    assert len(index.pts) == sum(LENGTHS)
    assert not index.damaged.size
    assert index.count_damaged(0.0, 1e9, 20) == 0


def test_what_is_overwritten_is_found(packed):
    """Any block that holds the head of a packet: zeros, or bytes of something else."""
    video = find_video(packed)
    content = video.read_bytes()
    packets = find_packets(video)
    rng = np.random.default_rng(0)
    for number in rng.choice(len(packets), 12, replace=False):
        place, size = packets[number]
        for filling in (bytes(size), rng.bytes(size)):
            video.write_bytes(content[:place] + filling + content[place + size :])
            try:
                index = index_video(packed, video.relative_to(packed))
            finally:
                video.write_bytes(content)
            assert number in index.damaged
            time = float(index.times[number])
            assert index.count_damaged(time, time + 1 / 20, 20) >= 1


def test_inspect_names_the_episode(damaged, capsys):
    before = compute_digests(damaged)
    assert main(["inspect", "--root", str(damaged), "--quiet"]) == 1
    text = capsys.readouterr().err
    assert "file-000.mp4 is damaged: " in text
    assert "of the 25 images of episode 1" in text
    assert "of episode 0" not in text
    assert compute_digests(damaged) == before


def test_filter_does_not_pass_it_on(damaged, tmp_path, capsys):
    out = tmp_path / "out"
    flags = ["--root", str(damaged), "--out", str(out), "--quiet"]
    assert main(["filter", *flags, "--where", "duration > 0"]) == 1
    text = capsys.readouterr().err
    assert "file-000.mp4 is damaged: " in text
    assert 'and readable" leaves such episodes out' in text
    assert not out.exists()
    assert main(["filter", *flags, "--where", "readable"]) == 0
    assert "2 of 3 episodes kept" in capsys.readouterr().out
    dataset = LeRobotDataset("local/out", root=out)
    assert [get_row(dataset, i)["task"] for i in (0, 40)] == ["task 0", "task 0"]
    assert len(dataset) == LENGTHS[0] + LENGTHS[2]


def test_repair_keeps_the_others(damaged, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["repair", "--root", str(damaged), "--out", str(out), "--quiet"]) == 0
    text = capsys.readouterr().out
    assert "episode 1 is lost: " in text
    assert "images of 'observation.images.top' are damaged" in text
    assert "complete: 2 episodes, 81 frames. Lost: 1" in text


@given(st.binary(max_size=64))
def test_the_framing_of_anything_is_judged_without_an_error(packet):
    assert is_whole_nal(packet) in (True, False)
    assert is_whole_av1(packet) in (True, False)


@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=5), st.integers(1, 4))
def test_units_after_their_lengths_are_whole_and_no_part_of_them_is(units, lost):
    units = [bytes([unit[0] & 0x7F]) + unit[1:] for unit in units]
    packet = b"".join(len(unit).to_bytes(4, "big") + unit for unit in units)
    assert is_whole_nal(packet)
    if lost < len(units[-1]):
        assert not is_whole_nal(packet[:-lost])
    assert not is_whole_nal(bytes(len(packet)))
