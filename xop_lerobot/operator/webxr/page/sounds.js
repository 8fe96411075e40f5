// A sound for each cue, made of tones.

/** What each cue sounds like: tones as [pitch in Hz, begin in s, length in s]. */
export const TUNES = {
  engaged: [[440, 0, 0.12], [660, 0.12, 0.2]],
  disengaged: [[660, 0, 0.12], [440, 0.12, 0.25]],
  refused: [[160, 0, 0.14], [160, 0.2, 0.2]],
  mode: [[880, 0, 0.07], [880, 0.12, 0.07]],
  setting: [[740, 0, 0.08]],
  end: [[523, 0, 0.1], [659, 0.1, 0.1], [523, 0.2, 0.2]],
  redo: [[587, 0, 0.1], [392, 0.1, 0.1], [587, 0.2, 0.15]],
  stop: [[392, 0, 0.18], [330, 0.18, 0.18], [262, 0.36, 0.35]],
  success: [[523, 0, 0.1], [659, 0.1, 0.1], [784, 0.2, 0.1], [1047, 0.3, 0.3]],
  warning: [[300, 0, 0.06], [300, 0.1, 0.06], [300, 0.2, 0.06]],
};

const OTHER = [[600, 0, 0.1]];
const LOUDNESS = 0.15;
const FADE_S = 0.015; // a tone that begins at once clicks

/** Plays tunes, once somebody has touched the page: browsers ask for that. */
export class Sounds {
  muted = false;
  played = [];

  #context = null;

  /** To be called within a click or a key. */
  unlock() {
    this.#context ??= new AudioContext();
    if (this.#context.state === 'suspended') this.#context.resume();
  }

  /** Play the tune of a cue; cues that are not known have one in common. */
  play(cue) {
    this.played = [...this.played.slice(-19), cue];
    const context = this.#context;
    if (this.muted || context?.state !== 'running') return;
    for (const [pitch, begin, length] of TUNES[cue] ?? OTHER) {
      const at = context.currentTime + begin;
      const tone = new OscillatorNode(context, { frequency: pitch, type: 'triangle' });
      const volume = new GainNode(context, { gain: 0 });
      volume.gain.setValueAtTime(0, at);
      volume.gain.linearRampToValueAtTime(LOUDNESS, at + FADE_S);
      volume.gain.setValueAtTime(LOUDNESS, at + length - FADE_S);
      volume.gain.linearRampToValueAtTime(0, at + length);
      tone.connect(volume).connect(context.destination);
      tone.start(at);
      tone.stop(at + length);
    }
  }
}
