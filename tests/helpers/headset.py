"""An emulated headset in a real browser: Meta's Immersive Web Emulation Runtime, fetched once."""

from __future__ import annotations

import base64
import fcntl
import hashlib
import json
import shutil
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import pytest

VERSION = "2.5.0"
INTEGRITY = (
    "sha512-grq7iMyWo4s2DYnATKLPPoAByhcNuwLjMHHOILrFU9q8"
    "EGHIEzHyUuq1mz+9Xqy6+xrYPn3Ho8Z9eymZCE+D6w=="
)
CACHE = Path.home() / ".cache/xop-lerobot/test"
RUNTIME = "package/build/iwer.min.js"


def load_runtime() -> str:
    """The emulator's script, from the cache or from npm; skips where neither has it."""
    archive = CACHE / f"iwer-{VERSION}.tgz"
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another worker of pytest may be fetching it
        if not archive.exists():
            _fetch(archive)
    digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
    assert f"sha512-{digest}" == INTEGRITY, f"{archive} is not iwer {VERSION}; delete it"
    with tarfile.open(archive) as packed:
        script = packed.extractfile(RUNTIME)
        assert script
        return script.read().decode()


def _fetch(archive: Path) -> None:
    if shutil.which("npm") is None:
        pytest.skip(f"needs iwer {VERSION}, and there is no npm to fetch it")
    command = ["npm", "pack", f"iwer@{VERSION}", "--pack-destination", str(CACHE)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=CACHE)
    except subprocess.TimeoutExpired:
        pytest.skip(f"needs iwer {VERSION}, and npm does not answer")
    if done.returncode != 0 or not archive.exists():
        pytest.skip(f"needs iwer {VERSION}, and npm cannot fetch it: {done.stderr[-300:]}")


# A headset whose wearer is alive: poses that a test sets sway by a millimetre, as a person does,
# and with `embody` the wearer moves as the page's own stand-in does.
WEARER = """
(() => {
  const device = new IWER.XRDevice(
    { ...IWER.metaQuest3, supportedSessionModes: MODES }, { stereoEnabled: true });
  device.installRuntime({ forceInstall: true });
  device.primaryInputMode = 'hand';
  const wearer = { still: false, pose: null, pinch: [0, 0], person: null, guessed: false };
  window.device = device;
  window.wearer = wearer;
  wearer.embody = async () => {
    wearer.person = new (await import('/standin.js')).StandIn();
  };
  // The emulator calls every controller's place guessed; here, hands and controllers are on demand.
  Object.defineProperty(XRPose.prototype, 'emulatedPosition', {
    get() { return wearer.guessed && !(this instanceof XRViewerPose); },
  });
  // The emulator holds a hand at its ray, against which the wrist of a pinch is turned like this.
  const straighten = (pose, side) => {
    if (side < 0) return pose;
    const [x, y, z, w] = [-0.3080, side ? -0.2148 : 0.2148, side ? -0.0281 : 0.0281, 0.9264];
    const [a, b, c, d] = pose.slice(3);
    return [...pose.slice(0, 3), d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
      d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z];
  };
  const put = (target, [x, y, z, qx, qy, qz, qw], sway) => {
    target.position.set(x + sway[0], y + sway[1], z + sway[2]);
    target.quaternion.set(qx, qy, qz, qw);
  };
  let last = 0;
  const live = (now) => {
    requestAnimationFrame(live);
    const t = now / 1000;
    const { person } = wearer;
    const sway = [0, 1, 2].map((i) => (wearer.still || person ? 0 : 0.001 * Math.sin((2 + i) * t)));
    if (person) {
      person.step(t - last);
      const { head, left, right, pinch } = person.pose;
      wearer.pose = [head, left, right].map((pose, i) => straighten(pose, i - 1));
      wearer.pinch = pinch.map((distance) => Math.min(Math.max((0.08 - distance) / 0.072, 0), 1));
    }
    last = t;
    if (!wearer.pose) return;
    put(device, wearer.pose[0], sway);
    ['left', 'right'].forEach((side, i) => {
      put(device.hands[side], wearer.pose[i + 1], sway);
      device.hands[side].updatePinchValue(wearer.pinch[i]);
      put(device.controllers[side], wearer.pose[i + 1], sway);
    });
  };
  requestAnimationFrame(live);
})();
"""


def install(page: Any, modes: tuple[str, ...] = ("immersive-vr", "immersive-ar")) -> None:
    """Give `page` the emulator, before it loads anything."""
    page.add_init_script(load_runtime())
    page.add_init_script(WEARER.replace("MODES", json.dumps(modes)))
