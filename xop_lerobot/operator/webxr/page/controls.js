// Keys, mouse and the key caps of the page, for the stand-in operator.

const METRES_PER_PIXEL = 0.0013;
const METRES_PER_NOTCH = 0.0006; // of the wheel, whose notch has about 100
const GROUPS = [
  ['Robot', [
    ['Space', 'Space', 'engage, disengage', 'engage'],
    ['KeyM', 'M', 'double pinch left', '!tapLeft'],
    ['KeyK', 'K', 'double pinch right', '!tapRight'],
    ['KeyN', 'N', 'double pinch both', '!tapBoth'],
  ]],
  ['Walk', [
    ['KeyW', 'W', 'forward', 'forward'], ['KeyS', 'S', 'back', 'back'],
    ['KeyA', 'A', 'left', 'left'], ['KeyD', 'D', 'right', 'right'],
    ['KeyQ', 'Q', 'turn left', 'turnLeft'], ['KeyE', 'E', 'turn right', 'turnRight'],
  ]],
  ['Head', [
    ['KeyR', 'R', 'up', 'up'], ['KeyF', 'F', 'down: squat', 'down'],
    ['KeyT', 'T', 'look up', 'lookUp'], ['KeyG', 'G', 'look down', 'lookDown'],
  ]],
  ['Hands', [
    ['Digit1', '1', 'pinch left', 'pinchLeft'], ['Digit2', '2', 'pinch right', 'pinchRight'],
    ['KeyZ', 'Z', 'raise left', 'raiseLeft'], ['KeyX', 'X', 'raise right', 'raiseRight'],
    ['KeyP', 'P', 'palms inwards, down', '!palms'],
  ]],
];
const MOUSE = [
  ['drag', 'right hand'], ['Shift + drag', 'left hand'],
  ['wheel', 'nearer, farther'], ['B + drag', 'both hands'],
];
const ARROWS = { ArrowUp: 'forward', ArrowDown: 'back', ArrowLeft: 'left', ArrowRight: 'right' };
const BOTH = 'KeyB';

/** A title, and below it pairs of a key and what it does. */
function makeGroup(title, pairs, kind = '') {
  const make = (tag, fields) => Object.assign(document.createElement(tag), fields);
  const group = make('div', { className: `group ${kind}` });
  group.append(make('b', { textContent: title }), ...pairs.map(([key, meaning]) => {
    const pair = make('div', { className: 'pair' });
    pair.append(key, meaning);
    return pair;
  }));
  return group;
}

/** Leads keys and mouse to a stand-in, from its making until `close`. */
export class Controls {
  /**
   * @param {StandIn} person
   * @param {HTMLElement} screen what is dragged on
   * @param {HTMLElement} caps where the keys are shown
   */
  constructor(person, screen, caps) {
    this.person = person;
    this.caps = new Map();
    this.actions = { ...ARROWS };
    this.both = false;
    this.#showCaps(caps);
    const stop = new AbortController();
    this.close = () => {
      stop.abort();
      caps.replaceChildren();
    };
    const listen = (target, name, handle) => {
      target.addEventListener(name, handle, { signal: stop.signal, passive: false, capture: true });
    };
    listen(window, 'keydown', (event) => this.#press(event));
    listen(window, 'keyup', (event) => this.#lift(event));
    listen(window, 'blur', () => this.releaseAll());
    listen(screen, 'pointerdown', (event) => this.#grab(event, screen));
    listen(screen, 'pointermove', (event) => this.#drag(event, screen));
    listen(screen, 'wheel', (event) => this.#roll(event));
    listen(screen, 'contextmenu', (event) => event.preventDefault());
  }

  /** Let go of all keys. */
  releaseAll() {
    this.person.releaseAll();
    this.both = false;
    for (const cap of this.caps.values()) cap.classList.remove('down');
  }

  #showCaps(caps) {
    const groups = GROUPS.map(([title, keys]) => makeGroup(title, keys.map(
      ([code, label, meaning, action]) => {
        this.actions[code] = action;
        return [this.#makeCap(label, meaning, action), meaning];
      },
    )));
    const mouse = makeGroup('Mouse, on the image', MOUSE.map(([how, what]) => [
      Object.assign(document.createElement('kbd'), { textContent: how }), what,
    ]), 'mouse');
    caps.replaceChildren(...groups.slice(0, 2), mouse, ...groups.slice(2));
  }

  #makeCap(label, meaning, action) {
    const cap = Object.assign(document.createElement('button'), {
      type: 'button', textContent: label, tabIndex: -1,
    });
    cap.setAttribute('aria-label', meaning);
    cap.dataset.action = action;
    cap.addEventListener('pointerdown', (event) => {
      cap.setPointerCapture(event.pointerId);
      this.#begin(action, cap);
    });
    for (const name of ['pointerup', 'pointercancel']) {
      cap.addEventListener(name, () => this.#end(action, cap));
    }
    this.caps.set(action, cap);
    return cap;
  }

  #begin(action, cap) {
    cap?.classList.add('down');
    if (action === '!tapLeft') this.person.doublePinch(0);
    else if (action === '!tapRight') this.person.doublePinch(1);
    else if (action === '!tapBoth') [0, 1].forEach((side) => this.person.doublePinch(side));
    else if (action === '!palms') this.person.turnPalms();
    else this.person.hold(action);
  }

  #end(action, cap) {
    cap?.classList.remove('down');
    this.person.release(action);
  }

  #isOurs(event) {
    // Keys of the browser stay the browser's, and who writes somewhere writes.
    const writes = event.target instanceof Element && event.target.closest('input, textarea');
    if (event.ctrlKey || event.metaKey || event.altKey || writes) return false;
    return event.code in this.actions || event.code === BOTH;
  }

  #press(event) {
    if (!this.#isOurs(event)) return;
    event.preventDefault(); // also keeps Space from pressing a button of the page
    if (event.repeat) return;
    if (event.code === BOTH) this.both = true;
    else this.#begin(this.actions[event.code], this.caps.get(this.actions[event.code]));
  }

  #lift(event) {
    if (event.code === BOTH) this.both = false;
    const action = this.actions[event.code];
    if (!action) return;
    if (this.#isOurs(event)) event.preventDefault();
    this.#end(action, this.caps.get(action));
  }

  #grab(event, screen) {
    if (event.button !== 0) return;
    event.preventDefault();
    screen.setPointerCapture(event.pointerId);
  }

  #drag(event, screen) {
    if (!screen.hasPointerCapture(event.pointerId)) return;
    const right = event.movementX * METRES_PER_PIXEL;
    this.#move(event, right, -event.movementY * METRES_PER_PIXEL, 0);
  }

  #roll(event) {
    event.preventDefault();
    // With Shift, browsers turn the wheel sideways.
    this.#move(event, 0, 0, (event.deltaY || event.deltaX) * METRES_PER_NOTCH);
  }

  #move(event, right, up, back) {
    if (this.both) {
      this.person.moveHand(0, [-right, up, back]);
      this.person.moveHand(1, [right, up, back]);
    } else {
      this.person.moveHand(event.shiftKey ? 0 : 1, [right, up, back]);
    }
  }
}
