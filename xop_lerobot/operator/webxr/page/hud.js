// The words before the wearer's eyes, drawn as an image.

import { describeDelay, describeMode, describeRecording, describeState } from './words.js';

const WIDTH = 1024;
const HEIGHT = 400;
const COLOURS = {
  good: '#5fd38d', plain: '#e8edf2', warn: '#ffc857', bad: '#ff7b72', soft: '#9fb0c0',
};
const FONT = 'system-ui, sans-serif';
const MARGIN = 28;
const NOTICE_S = 8; // how long the last notice stays

/** Break a text into lines of at most `width` pixels, at most `count` of them. */
function wrap(context, text, width, count) {
  const lines = [];
  let line = '';
  for (const word of text.split(' ')) {
    const longer = line ? `${line} ${word}` : word;
    if (line && context.measureText(longer).width > width) {
      lines.push(line);
      line = word;
    } else {
      line = longer;
    }
  }
  lines.push(line);
  if (lines.length > count) {
    lines.length = count;
    lines[count - 1] += ' …';
  }
  return lines;
}

/** Keeps an image of the state, drawn anew only when it says something else. */
export class Hud {
  constructor() {
    this.canvas = Object.assign(document.createElement('canvas'), { width: WIDTH, height: HEIGHT });
    this.picture = null;
    this.display = null;
    this.trouble = ''; // of the connection
    this.engage = ''; // how to engage, in words
    this.notice = '';
    this.noticeUntil = 0;
    this.drawn = '';
  }

  /** Show a notice for a while. */
  tell(text) {
    this.notice = text;
    this.noticeUntil = performance.now() + NOTICE_S * 1000;
  }

  /** Draw it, if anything has changed; returns whether it has. */
  update(troubles) {
    const notice = performance.now() < this.noticeUntil ? this.notice : '';
    const { display } = this;
    const wrong = [this.trouble, ...(display?.warnings ?? []), ...troubles].filter(Boolean);
    const asks = display && !display.engaged && !display.fallen && this.engage;
    const lines = [describeState(display), describeMode(display), describeRecording(display),
      describeDelay(display), wrong, notice, asks ? `To engage: ${this.engage}` : '',
      Math.round((display?.clutch ?? 0) * 50)];
    const key = JSON.stringify(lines);
    if (key === this.drawn) return false;
    this.drawn = key;
    this.#draw(...lines);
    return true;
  }

  #draw(state, mode, recording, delay, wrong, notice, hint, clutch) {
    const context = this.canvas.getContext('2d');
    const write = (text, x, y, colour, size, weight = 400, align = 'left') => {
      context.font = `${weight} ${size}px ${FONT}`;
      context.textAlign = align;
      context.fillStyle = colour;
      context.fillText(text, x, y);
    };
    context.clearRect(0, 0, WIDTH, HEIGHT);
    context.fillStyle = 'rgba(12, 17, 24, 0.88)';
    context.beginPath();
    context.roundRect(0, 0, WIDTH, HEIGHT, 24);
    context.fill();
    write(state.text, MARGIN, 66, COLOURS[state.tone], 50, 700);
    write(delay.text, WIDTH - MARGIN, 64, COLOURS[delay.tone], 36, 400, 'right');
    write(mode, MARGIN, 122, COLOURS.plain, 36);
    write(recording.text, WIDTH - MARGIN, 122, COLOURS[recording.tone], 36, 400, 'right');
    context.fillStyle = '#2c3948';
    context.fillRect(MARGIN, 144, WIDTH - 2 * MARGIN, 12);
    context.fillStyle = COLOURS.warn;
    context.fillRect(MARGIN, 144, ((WIDTH - 2 * MARGIN) * clutch) / 50, 12);
    let y = 204;
    context.font = `400 36px ${FONT}`;
    const room = WIDTH - 2 * MARGIN;
    const write36 = (text, colour, count) => {
      for (const line of wrap(context, text, room, count)) {
        if (y < HEIGHT) write(line, MARGIN, y, colour, 36);
        y += 46;
      }
    };
    if (wrong.length) write36(`⚠ ${wrong.join('  ⚠ ')}`, COLOURS.warn, notice || hint ? 3 : 5);
    if (notice) write36(notice, COLOURS.plain, wrong.length || hint ? 2 : 5);
    if (hint) write36(hint, COLOURS.soft, 3);
  }
}
