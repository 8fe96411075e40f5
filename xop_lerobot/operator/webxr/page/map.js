// The operator from above: where head and hands are, and where they have been.

import { rotate } from './motion.js';

const SCALE = 110; // pixels to the metre
const GRID = 0.5; // [m]
const TRAIL = 200; // places that are remembered
const HANDS = { left: ['L', '#ffc857'], right: ['R', '#4aa3ff'] };

/** The heading of a head from where its forward and left axes point, as `compute_heading` has it. */
function findHeading([fx, fy], [lx, ly]) {
  return Math.atan2(fy - 2 * lx, fx + 2 * ly);
}

/** A place and heading in the operator's world (x forward, y left) from a pose of the protocol. */
export function fromOperator([x, y, , qw, qx, qy, qz]) {
  const [forward, left] = [[1, 0, 0], [0, 1, 0]].map((axis) => rotate([qx, qy, qz, qw], axis));
  return { x, y, heading: findHeading(forward, left) };
}

/** The same from a pose in the axes of WebXR (x right, y up, z back). */
export function fromWebXr([x, , z, qx, qy, qz, qw]) {
  const [forward, left] = [[0, 0, -1], [-1, 0, 0]].map((axis) => {
    const [ax, , az] = rotate([qx, qy, qz, qw], axis);
    return [-az, -ax];
  });
  return { x: -z, y: -x, heading: findHeading(forward, left) };
}

/** Draws head and hands around the middle of a canvas; forward is up. */
export class TopView {
  constructor(canvas) {
    this.canvas = canvas;
    this.trail = [];
    this.draw(null);
  }

  /** Show a `pose` message of the computer. */
  showOperator({ head, left, right }) {
    this.draw(head && fromOperator(head), left && fromOperator(left), right && fromOperator(right));
  }

  /** Show poses of this device. */
  showWebXr({ head, left, right }) {
    const hand = (each) => each && fromWebXr(each.wrist ?? each.grip);
    this.draw(head && fromWebXr(head), hand(left), hand(right));
  }

  draw(head, left = null, right = null) {
    const { canvas } = this;
    const context = canvas.getContext('2d');
    context.clearRect(0, 0, canvas.width, canvas.height);
    const middle = head ?? this.trail.at(-1) ?? { x: 0, y: 0 };
    const place = ({ x, y }) => [
      canvas.width / 2 - (y - middle.y) * SCALE,
      canvas.height * 0.6 - (x - middle.x) * SCALE,
    ];
    this.#drawGrid(context, place, middle);
    if (!head) {
      context.fillStyle = '#9fb0c0';
      context.font = '14px system-ui, sans-serif';
      context.textAlign = 'center';
      context.fillText('nobody is seen', canvas.width / 2, canvas.height * 0.6);
      return;
    }
    this.trail.push({ x: head.x, y: head.y });
    if (this.trail.length > TRAIL) this.trail.shift();
    context.strokeStyle = '#3f5468';
    context.lineWidth = 2;
    context.beginPath();
    for (const each of this.trail) context.lineTo(...place(each));
    context.stroke();
    this.#drawHead(context, place(head), head.heading);
    this.#drawHand(context, place, left, HANDS.left);
    this.#drawHand(context, place, right, HANDS.right);
  }

  #drawGrid(context, place, middle) {
    const { canvas } = this;
    context.strokeStyle = '#243140';
    context.lineWidth = 1;
    const near = (value) => Math.round(value / GRID) * GRID;
    for (let i = -4; i <= 4; i++) {
      const [x, y] = place({ x: near(middle.x) + i * GRID, y: near(middle.y) + i * GRID });
      context.beginPath();
      context.moveTo(x, 0);
      context.lineTo(x, canvas.height);
      context.moveTo(0, y);
      context.lineTo(canvas.width, y);
      context.stroke();
    }
  }

  #drawHead(context, [x, y], heading) {
    context.save();
    context.translate(x, y);
    context.rotate(-heading);
    context.fillStyle = '#e8edf2';
    context.beginPath();
    context.arc(0, 0, 11, 0, 2 * Math.PI);
    context.fill();
    context.beginPath();
    context.moveTo(-6, -9);
    context.lineTo(0, -20);
    context.lineTo(6, -9);
    context.fill();
    context.restore();
  }

  #drawHand(context, place, hand, [letter, colour]) {
    if (!hand) return;
    const [x, y] = place(hand);
    context.fillStyle = colour;
    context.beginPath();
    context.arc(x, y, 9, 0, 2 * Math.PI);
    context.fill();
    context.fillStyle = '#06121f';
    context.font = 'bold 12px system-ui, sans-serif';
    context.textAlign = 'center';
    context.textBaseline = 'middle';
    context.fillText(letter, x, y + 0.5);
    context.textBaseline = 'alphabetic';
  }
}
