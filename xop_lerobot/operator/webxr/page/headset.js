// A WebXR session: poses of head and hands for the robot, and what the wearer sees.

import { Stage } from './stage.js';

const JOINTS = { wrist: 'wrist', thumb: 'thumb-tip', index: 'index-finger-tip' };
const MODES = ['immersive-ar', 'immersive-vr'];
const TAKE_OVER_MS = 1000; // so long a hand must be lost until a controller speaks for its side

/** What a session can be begun as here, or why not, in words: `{mode, trouble}`. */
export async function findMode() {
  if (!window.isSecureContext) {
    const trouble = 'A headset needs an https address, or a cable: see docs/use/webxr.md.';
    return { mode: null, trouble };
  }
  if (!navigator.xr) return { mode: null, trouble: 'This browser has no WebXR.' };
  for (const mode of MODES) {
    try {
      if (await navigator.xr.isSessionSupported(mode)) return { mode, trouble: '' };
    } catch {
      return { mode: null, trouble: 'This browser does not let pages use a headset.' };
    }
  }
  return { mode: null, trouble: 'No headset is connected to this browser.' };
}

function explainStart(error) {
  const reasons = {
    NotAllowedError: 'The headset has not allowed it. Start again and allow hands and immersion.',
    SecurityError: 'The headset has not allowed it. Start again and allow hands and immersion.',
    NotSupportedError: 'This headset cannot show such a session.',
    InvalidStateError: 'Another session is open in this headset. Close it first.',
  };
  return reasons[error.name] ?? `The headset did not start: ${error.message}`;
}

function point(p) {
  return [p.x, p.y, p.z];
}

function flatten(pose) {
  const { position: p, orientation: q } = pose.transform;
  return [p.x, p.y, p.z, q.x, q.y, q.z, q.w];
}

/** A hand of 25 joints as the protocol has it, or null if it is not seen. */
function readHand(frame, hand, space) {
  const poses = {};
  for (const [name, joint] of Object.entries(JOINTS)) {
    const joints = hand.get(joint);
    const pose = joints && frame.getJointPose(joints, space);
    if (!pose) return null;
    poses[name] = pose;
  }
  return {
    wrist: flatten(poses.wrist),
    thumb: point(poses.thumb.transform.position),
    index: point(poses.index.transform.position),
    emulated: Object.values(poses).some((pose) => pose.emulatedPosition === true),
  };
}

/** A controller as the protocol has it, or null if it is not seen. */
function readController(frame, source, space) {
  const pose = frame.getPose(source.gripSpace, space);
  if (!pose) return null;
  return {
    grip: flatten(pose),
    trigger: source.gamepad?.buttons[0]?.value ?? 0,
    emulated: pose.emulatedPosition === true,
  };
}

/** How well something is seen: 0 not at all, 1 its place is guessed, 2 it is seen. */
function rate(seen) {
  if (!seen) return 0;
  return seen.emulated ? 1 : 2;
}

/**
 * Read head and hands.
 *
 * Headsets list hands and controllers at once, and what is listed need not be seen. On each side the
 * hand goes before the controller where both are seen: who lays the controllers down goes on with
 * the hands. A controller that lies about does not take over from a hand that is lost for a moment.
 *
 * @param {XRFrame} frame
 * @param {XRReferenceSpace} space
 * @param {number} time of the frame [ms]
 * @param {object} handsAt when the hand of each side was seen last [ms]; it is kept up to date
 * @returns {object} `source`, `head`, `left` and `right` of a frame of the protocol
 */
export function readFrame(frame, space, time = 0, handsAt = {}) {
  const viewer = frame.getViewerPose(space);
  const seen = { hands: {}, controllers: {} };
  const note = (kind, side, found) => {
    if (rate(found) > rate(seen[kind][side])) seen[kind][side] = found;
  };
  for (const source of frame.session.inputSources) {
    const side = source.handedness;
    if (side === 'none') continue;
    if (source.hand) note('hands', side, readHand(frame, source.hand, space));
    else if (source.gripSpace && source.targetRayMode === 'tracked-pointer') {
      note('controllers', side, readController(frame, source, space));
    }
  }
  const choose = (side) => {
    const [hand, controller] = [seen.hands[side] ?? null, seen.controllers[side] ?? null];
    if (rate(hand) === 2) handsAt[side] = time;
    const waits = time - (handsAt[side] ?? -Infinity) < TAKE_OVER_MS;
    return waits || rate(hand) >= rate(controller) ? ['hands', hand] : ['controllers', controller];
  };
  const [left, right] = [choose('left'), choose('right')];
  const kinds = [left, right].filter(([, found]) => found).map(([kind]) => kind);
  const source = kinds.every((kind) => kind === 'hands') ? 'hands' : 'controllers';
  const write = ([kind, found]) => found && (kind === source ? found : { source: kind, ...found });
  return {
    source,
    // A head whose place is guessed is as good as none.
    head: viewer && !viewer.emulatedPosition ? flatten(viewer) : null,
    left: write(left),
    right: write(right),
  };
}

/** What the wearer should know of the session, in words. */
function findTroubles(session, data, hasFloor) {
  const troubles = [];
  if (session.visibilityState === 'visible-blurred') {
    troubles.push('A menu of the headset is open: close it to go on.');
  }
  if (!hasFloor) troubles.push('The headset knows no floor: set it up, then start again.');
  if (!data.head) troubles.push('The headset has lost its position: look around.');
  if (!data.left && !data.right) troubles.push('No hand is seen: hold both hands in view.');
  else if (!data.left) troubles.push('The left hand is not seen.');
  else if (!data.right) troubles.push('The right hand is not seen.');
  if (data.left?.emulated || data.right?.emulated) troubles.push('A hand is only guessed.');
  return troubles;
}

/** One immersive session. */
export class Headset {
  /**
   * @param {object} handlers `frame(data)` with head and hands, `hidden(text)` when the headset is
   *   off or elsewhere, `shown()`, `moved(text)` before frames of another space, `ended(text)`
   * @param {object} hud what is drawn: `canvas`, `update(troubles)`, which tells whether anything
   *   has changed, and `picture`, an image or null
   */
  constructor(handlers, hud) {
    this.handlers = handlers;
    this.hud = hud;
    this.session = null;
    this.troubles = [];
    this.frames = 0;
  }

  /**
   * Begin; must be called within a tap.
   *
   * @throws {Error} whose message says in words why not
   */
  async start(mode) {
    let session;
    try {
      const optionalFeatures = ['local-floor', 'hand-tracking'];
      session = await navigator.xr.requestSession(mode, { optionalFeatures });
    } catch (error) {
      throw new Error(explainStart(error));
    }
    this.session = session;
    session.addEventListener('end', () => {
      this.session = null;
      this.handlers.ended('The session in the headset has ended.');
    });
    try {
      await this.#prepare(session, mode);
    } catch (error) {
      await session.end();
      throw new Error(`The headset cannot show this: ${error.message}`);
    }
  }

  async #prepare(session, mode) {
    this.stage = new Stage(session, mode === 'immersive-ar');
    let hasFloor = true;
    const space = await session.requestReferenceSpace('local-floor').catch(() => {
      hasFloor = false;
      return session.requestReferenceSpace('local');
    });
    // Nobody has moved, and yet head and hands are elsewhere from the next frame on.
    space.addEventListener('reset', () => {
      this.handlers.moved('the headset was recentred, or has found its place anew');
    });
    session.addEventListener('visibilitychange', () => {
      if (session.visibilityState === 'hidden') {
        this.handlers.hidden('The headset is off, or shows something else.');
      } else {
        this.handlers.shown();
      }
    });
    const handsAt = {};
    const tick = (time, frame) => {
      if (this.session !== session) return;
      session.requestAnimationFrame(tick);
      if (session.visibilityState === 'hidden') return;
      const data = readFrame(frame, space, time, handsAt);
      this.frames += 1;
      this.handlers.frame(data);
      this.troubles = findTroubles(session, data, hasFloor);
      const viewer = frame.getViewerPose(space);
      if (viewer) this.stage.draw(viewer, this.hud, this.troubles);
    };
    session.requestAnimationFrame(tick);
  }

  /** End the session. */
  async end() {
    await this.session?.end();
  }
}
