// Smooth motion: every change of a target is a movement of minimum jerk from wherever one is.

/** How much faster than its mean a movement of minimum jerk is at its peak. */
const PEAK = 1.875;

/**
 * Values that move to where they are aimed, with position, speed and acceleration continuous.
 *
 * From (p, v, a) the path is the polynomial of fifth degree that ends at the target, at rest,
 * after a given time: the path of minimum jerk with these ends. It may be aimed anew at any time.
 */
export class Glide {
  /** @param {number[]} values where it begins, at rest */
  constructor(values) {
    this.value = [...values];
    this.target = [...values];
    this.speed = values.map(() => 0);
    this.acceleration = values.map(() => 0);
    this.left = 0; // time to the target [s]
  }

  /**
   * Aim at `target`.
   *
   * @param {number[]} target
   * @param {number} seconds the least time that it takes
   * @param {number} fastest a movement that starts at rest is never faster [1/s]
   */
  aim(target, seconds, fastest = Infinity) {
    if (this.target.every((value, i) => value === target[i])) return;
    this.target = [...target];
    const distance = Math.hypot(...target.map((value, i) => value - this.value[i]));
    this.left = Math.max(seconds, (PEAK * distance) / fastest);
  }

  /** Let `dt` seconds pass; returns the values. */
  step(dt) {
    if (this.left <= dt) {
      this.value = [...this.target];
      this.speed.fill(0);
      this.acceleration.fill(0);
      this.left = 0;
      return this.value;
    }
    const T = this.left;
    for (let i = 0; i < this.value.length; i++) {
      const [p, v, a] = [this.value[i], this.speed[i], this.acceleration[i]];
      const d = this.target[i] - p;
      const c3 = (20 * d - 12 * v * T - 3 * a * T * T) / (2 * T ** 3);
      const c4 = (-30 * d + 16 * v * T + 3 * a * T * T) / (2 * T ** 4);
      const c5 = (12 * d - 6 * v * T - a * T * T) / (2 * T ** 5);
      this.value[i] = p + dt * (v + dt * (a / 2 + dt * (c3 + dt * (c4 + dt * c5))));
      this.speed[i] = v + dt * (a + dt * (3 * c3 + dt * (4 * c4 + dt * 5 * c5)));
      this.acceleration[i] = a + dt * (6 * c3 + dt * (12 * c4 + dt * 20 * c5));
    }
    this.left -= dt;
    return this.value;
  }
}

/** Quaternion x y z w of a turn by `angle` [rad] about an axis of unit length. */
export function turnAbout([x, y, z], angle) {
  const s = Math.sin(angle / 2);
  return [x * s, y * s, z * s, Math.cos(angle / 2)];
}

/** Product of two quaternions x y z w: first `b`, then `a`. */
export function multiply([ax, ay, az, aw], [bx, by, bz, bw]) {
  return [
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
    aw * bw - ax * bx - ay * by - az * bz,
  ];
}

/** Turn a vector by a quaternion x y z w. */
export function rotate(q, [x, y, z]) {
  const conjugate = [-q[0], -q[1], -q[2], q[3]];
  return multiply(multiply(q, [x, y, z, 0]), conjugate).slice(0, 3);
}
