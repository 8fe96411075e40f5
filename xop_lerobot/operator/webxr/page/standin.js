// The stand-in operator: a person made of mouse and keyboard, in the axes of WebXR.

import { Glide, multiply, rotate, turnAbout } from './motion.js';

const RIGHT = [1, 0, 0];
const UP = [0, 1, 0];
const BACK = [0, 0, 1];
const SIDES = ['left', 'right'];

const WALK = 0.5; // [m/s]
const TURN = 0.6; // [rad/s]
const CLIMB = 0.2; // change of the head's height [m/s]
const NOD = 0.5; // [rad/s]
const START_S = 0.4; // to reach such a speed, and to stop again
const HEIGHT = { start: 1.6, low: 0.8, high: 1.75 }; // of the head over the floor [m]
const PITCH = 0.9; // farthest nod up or down [rad]
const HAND = { x: 0.2, y: -0.48, z: -0.33 }; // of the right hand from the head [m]
const REACH = { min: [0, -0.9, -0.75], max: [0.65, 0.2, -0.12] }; // the same, outwards as x
const HAND_S = 0.3;
const HAND_SPEED = 1.2; // [m/s]
const PALMS_S = 0.5;
const RAISED = [0.24, -0.2, -0.36]; // of a right hand that says halt, from the head [m]
const OPEN = 0.08; // distance of thumb and index [m]
const CLOSED = 0.008;
const PINCH_S = 0.09;
const TAP = [0, 0.18, 0.36, 0.54]; // a double pinch: closes, opens, closes, opens [s]
const LONGEST = 0.04; // however long the browser paused, nobody has moved for longer [s]

/** What `hold` and `release` know besides gestures: kinds of speed, and their signs. */
export const DRIVES = {
  forward: ['walk', 0, -1], back: ['walk', 0, 1], left: ['walk', -1, 0], right: ['walk', 1, 0],
  turnLeft: ['turn', 1], turnRight: ['turn', -1],
  up: ['climb', 1], down: ['climb', -1],
  lookUp: ['nod', 1], lookDown: ['nod', -1],
};

/** Somebody who stands, sways a little, and does what is held. */
export class StandIn {
  constructor() {
    this.time = 0;
    this.place = [0, 0]; // x, z [m]
    this.yaw = 0;
    this.height = HEIGHT.start;
    this.pitch = 0;
    this.speeds = {
      walk: new Glide([0, 0]), turn: new Glide([0]), climb: new Glide([0]), nod: new Glide([0]),
    };
    this.hands = SIDES.map((_, i) => new Glide([i ? HAND.x : -HAND.x, HAND.y, HAND.z]));
    this.palms = new Glide([0]); // turned about the fingers: 0 down, π up [rad]
    this.facing = new Glide([0]); // 1: the palms face each other
    this.raises = SIDES.map(() => new Glide([0])); // 1: fingers up, palm forward
    this.pinches = SIDES.map(() => new Glide([OPEN]));
    this.held = new Set();
    this.taps = [null, null]; // when the double pinch of a hand began [s]
  }

  /** Begin to do something: a name of `DRIVES`, `engage`, or `pinch` or `raise` with a side. */
  hold(name) {
    this.held.add(name);
  }

  /** Stop doing it. */
  release(name) {
    this.held.delete(name);
  }

  /** Let go of everything, as when the keyboard goes to another window. */
  releaseAll() {
    this.held.clear();
  }

  /** Pinch twice with hand 0 (left) or 1 (right). */
  doublePinch(side) {
    if (this.taps[side] === null) this.taps[side] = this.time;
  }

  /** Turn the palms: down, or to face each other as for a box. */
  turnPalms() {
    this.facing.aim([this.facing.target[0] ? 0 : 1], PALMS_S);
  }

  /**
   * Move a hand's aim by metres to the right, up and back, as far as an arm goes.
   *
   * @param {number} side 0 left, 1 right
   * @param {number[]} by [m]
   */
  moveHand(side, by) {
    const mirror = side ? 1 : -1;
    const aim = this.hands[side].target.map((value, i) => {
      const sign = i === 0 ? mirror : 1;
      const outwards = sign * (value + by[i]);
      return sign * Math.min(Math.max(outwards, REACH.min[i]), REACH.max[i]);
    });
    this.hands[side].aim(aim, HAND_S, HAND_SPEED);
  }

  /** Let `dt` seconds pass. */
  step(dt) {
    dt = Math.min(dt, LONGEST);
    this.time += dt;
    const speeds = { walk: [0, 0], turn: [0], climb: [0], nod: [0] };
    for (const name of this.held) {
      const [kind, ...signs] = DRIVES[name] ?? [null];
      if (kind) signs.forEach((sign, i) => { speeds[kind][i] += sign; });
    }
    const scales = { walk: WALK, turn: TURN, climb: CLIMB, nod: NOD };
    for (const [kind, signs] of Object.entries(speeds)) {
      this.speeds[kind].aim(signs.map((sign) => sign * scales[kind]), START_S);
      this.speeds[kind].step(dt);
    }
    const level = turnAbout(UP, this.yaw);
    const [side, forth] = this.speeds.walk.value;
    const [x, , z] = rotate(level, [side, 0, forth]);
    this.place = [this.place[0] + x * dt, this.place[1] + z * dt];
    this.yaw += this.speeds.turn.value[0] * dt;
    this.height = this.#creep('climb', this.height, dt, HEIGHT.low, HEIGHT.high);
    this.pitch = this.#creep('nod', this.pitch, dt, -PITCH, PITCH);
    this.#closeHands(dt);
    this.hands.forEach((hand) => hand.step(dt));
    this.facing.step(dt);
  }

  /** Go on at the speed of `kind`, ever slower towards the end of the range. */
  #creep(kind, value, dt, low, high) {
    const speed = this.speeds[kind].value[0];
    const room = speed > 0 ? high - value : value - low;
    return value + speed * dt * Math.min(Math.max(room / 0.1, 0), 1);
  }

  #closeHands(dt) {
    const engaging = this.held.has('engage');
    this.palms.aim([engaging ? Math.PI : 0], PALMS_S);
    this.palms.step(dt);
    // Hands must be seen open before they close, also by who has just connected.
    const closing = engaging && this.palms.value[0] > 0.9 * Math.PI;
    this.raises.forEach((raise, side) => {
      raise.aim([this.held.has(side ? 'raiseRight' : 'raiseLeft') ? 1 : 0], PALMS_S);
      raise.step(dt);
    });
    this.pinches.forEach((pinch, side) => {
      const began = this.taps[side];
      const since = began === null ? -1 : this.time - began;
      if (since > TAP[3]) this.taps[side] = null;
      const tapping = (since >= TAP[0] && since < TAP[1]) || (since >= TAP[2] && since < TAP[3]);
      const held = this.held.has(side ? 'pinchRight' : 'pinchLeft');
      pinch.aim([closing || tapping || held ? CLOSED : OPEN], PINCH_S);
      pinch.step(dt);
    });
  }

  /** Head and wrists now: each `[x, y, z, qx, qy, qz, qw]`, and the pinches [m]. */
  get pose() {
    const t = this.time;
    // Nobody stands like a statue, and what does not change by a bit counts as a frozen stream.
    const sway = [
      0.003 * Math.sin(1.3 * t) + 0.001 * Math.sin(5.1 * t),
      0.001 * Math.sin(0.9 * t + 1),
      0.003 * Math.sin(1.7 * t + 2) + 0.001 * Math.sin(4.3 * t),
    ];
    const level = multiply(turnAbout(UP, this.yaw + 0.004 * Math.sin(1.1 * t)), [0, 0, 0, 1]);
    const head = [this.place[0] + sway[0], this.height + sway[1], this.place[1] + sway[2]];
    const look = multiply(level, turnAbout(RIGHT, this.pitch + 0.003 * Math.sin(0.8 * t)));
    const wrists = this.hands.map((hand, side) => {
      const mirror = side ? 1 : -1;
      const tremor = [0, 1, 2].map((i) => 0.001 * Math.sin((2.1 + 0.7 * i) * t + i + 2 * side));
      const raised = this.raises[side].value[0];
      const high = [mirror * RAISED[0], RAISED[1], RAISED[2]];
      const place = hand.value.map((value, i) => value + raised * (high[i] - value) + tremor[i]);
      const from = rotate(level, place);
      // About the fingers (-z): the thumbs turn outwards for palms up, and up for palms inwards.
      const roll = mirror * (this.palms.value[0] + (this.facing.value[0] * Math.PI) / 2
        * (1 - this.palms.value[0] / Math.PI));
      const lift = multiply(level, turnAbout(RIGHT, (raised * Math.PI) / 2));
      return [...head.map((value, i) => value + from[i]),
        ...multiply(lift, turnAbout(BACK, -roll))];
    });
    const [left, right] = wrists;
    return { head: [...head, ...look], left, right, pinch: this.pinches.map((p) => p.value[0]) };
  }
}
