// The page's words: what it shows of the robot, the recording and what has happened.

import {
  describeDelay, describeMode, describeOperator, describeRecording, describeState,
} from './words.js';

const SURE_MS = 3000; // how long "press again" waits
const KEPT = 5;

const byId = (id) => document.getElementById(id);

function write(element, { text, tone }) {
  element.textContent = text;
  element.className = tone;
}

/** Shows what comes from the computer. */
export class Panel {
  /** @param {object} handlers `wish(name)`, `cue(name, text)` for each thing that is new */
  constructor(handlers) {
    this.handlers = handlers;
    this.number = null; // of the newest notice that was shown
    this.warnings = '';
    for (const button of document.querySelectorAll('[data-wish]')) this.#prepareWish(button);
    this.show(null);
  }

  /** Forget which notices were shown: another recording counts anew. */
  forget() {
    this.number = null;
  }

  #prepareWish(button) {
    const label = button.textContent;
    const isDire = button.dataset.wish === 'redo';
    let timer = 0;
    const calm = () => {
      button.textContent = label;
      button.classList.remove('sure');
      timer = 0;
    };
    button.addEventListener('click', () => {
      if (isDire && !timer) {
        button.textContent = 'Press again';
        button.classList.add('sure');
        timer = setTimeout(calm, SURE_MS);
        return;
      }
      clearTimeout(timer);
      calm();
      this.handlers.wish(button.dataset.wish);
    });
  }

  /** Show a `display` message, or that there is none. */
  show(display) {
    write(byId('state'), describeState(display));
    byId('screen').classList.toggle('engaged', display?.engaged === true);
    byId('mode').textContent = describeMode(display);
    write(byId('operator'), describeOperator(display));
    write(byId('delay'), describeDelay(display));
    write(byId('recording'), describeRecording(display));
    const clutch = display?.clutch ?? 0;
    byId('clutch').hidden = !(clutch > 0);
    byId('clutch').firstElementChild.style.width = `${100 * clutch}%`;
    for (const button of document.querySelectorAll('[data-wish]')) {
      button.disabled = !display?.progress;
      button.classList.toggle(
        'lit', button.dataset.wish === 'success' && display?.progress?.success === true,
      );
    }
    this.#showWarnings(display?.warnings ?? []);
    if (display) this.#showNotices(display.notices ?? []);
  }

  #showWarnings(warnings) {
    const key = warnings.join('\n');
    if (key === this.warnings) return;
    if (warnings.some((each) => !this.warnings.includes(each))) this.handlers.cue('warning', '');
    this.warnings = key;
    byId('warnings').hidden = warnings.length === 0;
    byId('warnings').querySelector('ul').replaceChildren(
      ...warnings.map((text) => Object.assign(document.createElement('li'), { textContent: text })),
    );
  }

  #showNotices(notices) {
    const newest = notices.at(-1)?.number ?? 0;
    // A board that counts from the beginning belongs to another recording.
    if (this.number !== null && newest < this.number) this.number = 0;
    const fresh = notices.filter(({ number }) => number > (this.number ?? 0));
    if (!fresh.length) {
      this.number ??= newest;
      return;
    }
    const list = byId('notices').querySelector('ol');
    list.querySelector('.empty')?.remove();
    for (const { cue, text } of fresh) {
      const item = document.createElement('li');
      const time = document.createElement('time');
      time.textContent = new Date().toLocaleTimeString([], { hour12: false });
      item.append(time, text);
      list.prepend(item);
      // What happened before this page was there makes no sound.
      if (this.number !== null) this.handlers.cue(cue, text);
    }
    while (list.children.length > KEPT) list.lastElementChild.remove();
    this.number = newest;
  }

  /** List what the gestures do: texts by name. */
  showGestures(gestures) {
    byId('gestures').replaceChildren(...Object.entries(gestures ?? {}).flatMap(([name, text]) => [
      Object.assign(document.createElement('dt'), { textContent: name }),
      Object.assign(document.createElement('dd'), { textContent: text }),
    ]));
  }
}
