// The page: a monitor at first; on request a stand-in operator, or an operator in a headset.

import { Controls } from './controls.js';
import { Headset, findMode } from './headset.js';
import { Hud } from './hud.js';
import { Link } from './link.js';
import { TopView } from './map.js';
import { Panel } from './panel.js';
import { Pictures, paint } from './pictures.js';
import { Sounds } from './sounds.js';
import { StandIn } from './standin.js';

const byId = (id) => document.getElementById(id);

/** The pairing code in the page's address, where it may stand behind `?` or `#`. */
function findCode() {
  const places = [location.search, location.hash].map((text) => new URLSearchParams(text.slice(1)));
  return places.map((place) => place.get('code')).find(Boolean) ?? '';
}

/** All of it together; there is one. */
class App {
  constructor() {
    this.code = findCode();
    this.link = null;
    this.person = null; // the stand-in, while it drives
    this.headset = null; // while a session runs
    this.sounds = new Sounds();
    this.hud = new Hud();
    this.map = new TopView(byId('map'));
    this.panel = new Panel({
      wish: (wish) => this.link?.send({ type: 'wish', wish }),
      cue: (cue, text) => {
        this.sounds.play(cue);
        if (text) this.hud.tell(text);
      },
    });
    this.pictures = new Pictures((camera, picture) => this.#showPicture(camera, picture));
    this.#listen();
    this.lookForHeadset();
    byId('address').textContent = location.origin;
    byId('local').hidden = !['localhost', '127.0.0.1', '[::1]'].includes(location.hostname);
    byId('reverse').textContent = `adb reverse tcp:${location.port} tcp:${location.port}`;
    if (this.code) this.connect('monitor');
    else this.#askForCode('This page needs the pairing code of the robot\'s computer.');
  }

  #listen() {
    window.addEventListener('pointerdown', () => this.sounds.unlock());
    window.addEventListener('keydown', () => this.sounds.unlock());
    byId('sound').addEventListener('click', () => {
      const { sounds } = this;
      sounds.muted = !sounds.muted;
      byId('sound').textContent = sounds.muted ? 'Sound off' : 'Sound on';
      byId('sound').setAttribute('aria-pressed', String(!sounds.muted));
    });
    byId('ask').addEventListener('submit', (event) => {
      event.preventDefault();
      this.code = byId('code').value.trim();
      byId('ask').hidden = true;
      this.#tell('');
      this.connect('monitor');
    });
    byId('drive').addEventListener('click', () => {
      if (this.person) this.stopDriving('');
      else this.#driveFromHere();
    });
    byId('headset').addEventListener('click', () => this.#startHeadset());
    navigator.xr?.addEventListener?.('devicechange', () => this.lookForHeadset());
    document.addEventListener('visibilitychange', () => {
      if (!this.person) return;
      if (document.hidden) {
        this.controls.releaseAll();
        this.link.send({ type: 'bye', reason: 'the page of the stand-in is hidden' });
        this.#tell('This page was hidden, and the robot was disengaged. Engage again.');
      }
    });
  }

  /** Offer a start in the headset where there is one. */
  async lookForHeadset() {
    const { mode, trouble } = await findMode();
    this.mode = mode;
    byId('headset').hidden = !mode;
    byId('drive').classList.toggle('main', !mode);
    byId('hint').textContent = mode ? '' : `${trouble} Mouse and keyboard can stand in for one.`;
  }

  /** Connect in another role; what was there before is closed. */
  connect(role) {
    this.link?.close();
    this.panel.forget();
    this.link = new Link(role, this.code, {
      state: (phase, text) => this.#showConnection(phase, text),
      message: (message) => this.#receive(message),
      picture: (camera, blob) => this.pictures.take(camera, blob),
    });
  }

  #showConnection(phase, text) {
    const does = this.link?.role === 'operator' ? 'drive' : 'watch';
    byId('connection').textContent = phase === 'open' ? `Connected: you ${does}` : text;
    byId('connection').className = phase;
    this.hud.trouble = phase === 'open' ? '' : text;
    if (phase !== 'open') {
      this.hud.display = null;
      this.panel.show(null);
    }
    if (phase !== 'refused') return;
    if (text.toLowerCase().startsWith('wrong code')) {
      this.#stopAll();
      this.#askForCode(text);
    } else if (this.link?.role === 'operator') {
      this.#stopAll();
      this.#tell(text);
      this.connect('monitor');
    } else {
      this.#tell(text);
    }
  }

  #askForCode(text) {
    this.#tell(text);
    byId('connection').textContent = 'Not connected';
    byId('connection').className = 'refused';
    byId('ask').hidden = false;
    byId('code').focus();
  }

  #tell(text) {
    byId('trouble').textContent = text;
    byId('trouble').hidden = !text;
  }

  #receive(message) {
    if (message.type === 'welcome') {
      byId('title').textContent = message.robot || 'Robot';
      document.title = `Drive ${message.robot || 'a robot'}`;
      this.panel.showGestures(message.gestures);
      this.hud.engage = message.gestures?.engage ?? '';
      this.#showConnection('open', '');
    } else if (message.type === 'display') {
      this.hud.display = message;
      this.panel.show(message);
    } else if (message.type === 'pose' && !this.person && !this.headset) {
      this.map.showOperator(message);
    }
  }

  #showPicture(camera, picture) {
    if (camera === 0) {
      byId('nothing').hidden = true;
      this.hud.picture?.close();
      this.hud.picture = picture;
      if (!this.headset) paint(byId('camera'), picture); // in a headset nobody sees the page
      return;
    }
    const id = `camera-${camera}`;
    if (!byId(id)) byId('others').append(Object.assign(document.createElement('canvas'), { id }));
    paint(byId(id), picture);
    picture.close();
  }

  #driveFromHere() {
    this.#tell('');
    this.connect('operator');
    this.person = new StandIn();
    this.controls = new Controls(this.person, byId('camera'), byId('caps'));
    this.#showDriving(true);
    let last = performance.now();
    const { person } = this;
    const tick = (now) => {
      if (this.person !== person) return;
      requestAnimationFrame(tick);
      person.step(Math.max(now - last, 0) / 1000);
      last = now;
      const { head, left, right, pinch } = person.pose;
      const data = {
        source: 'standin',
        head,
        left: { wrist: left, pinch: pinch[0] },
        right: { wrist: right, pinch: pinch[1] },
      };
      this.link.sendFrame(data);
      this.map.showWebXr(data);
    };
    requestAnimationFrame(tick);
  }

  #showDriving(drives) {
    byId('keys').hidden = !drives;
    byId('steps').hidden = !drives;
    byId('driving').hidden = !drives;
    byId('screen').classList.toggle('driving', drives);
    byId('drive').textContent = drives ? 'Stop driving' : 'Drive from here';
    byId('drive').classList.toggle('main', !drives && !this.mode);
    byId('hint').hidden = drives;
    if (drives) byId('drive').blur(); // or the space bar would press it
  }

  /** The stand-in leaves, and the page is a monitor again. */
  stopDriving(text) {
    this.link.send({ type: 'bye', reason: 'the stand-in has left' });
    this.#stopAll();
    this.#tell(text);
    this.connect('monitor');
  }

  #stopAll() {
    if (this.person) {
      this.person = null;
      this.controls.close();
      this.#showDriving(false);
    }
    const { headset } = this;
    this.headset = null;
    headset?.end();
  }

  async #startHeadset() {
    this.#tell('');
    this.#stopAll();
    const headset = new Headset({
      frame: (data) => {
        this.link.sendFrame(data);
      },
      hidden: (reason) => this.link.send({ type: 'bye', reason }),
      shown: () => this.sounds.play('setting'),
      moved: (reason) => this.link.send({ type: 'bye', reason }),
      ended: (reason) => {
        if (this.headset !== headset) return;
        this.link.send({ type: 'bye', reason });
        this.headset = null;
        this.#tell(reason);
        this.connect('monitor');
      },
    }, this.hud);
    try {
      await headset.start(this.mode);
    } catch (error) {
      this.#tell(error.message);
      return;
    }
    this.headset = headset;
    this.connect('operator');
  }
}

window.app = new App();
