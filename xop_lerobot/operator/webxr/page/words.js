// What the robot's computer tells, put into words; the page and the headset say the same.

/** Tones of a text: how it is coloured. */
export const TONE = { good: 'good', plain: 'plain', warn: 'warn', bad: 'bad' };

const SLOW_MS = [150, 300];
const LIMBS = ['head', 'left hand', 'right hand'];

/** Time as minutes and seconds. */
export function formatTime(seconds) {
  const whole = Math.floor(seconds);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, '0')}`;
}

/** Who drives, and whether the robot follows. */
export function describeState(display) {
  if (!display) return { text: 'Waiting for the robot', tone: TONE.plain };
  if (display.fallen) return { text: 'The robot has fallen', tone: TONE.bad };
  if (display.clutch > 0) return { text: display.holding || 'Keep holding', tone: TONE.warn };
  if (display.engaged) return { text: 'Engaged: the robot follows', tone: TONE.good };
  return { text: 'Holding: nobody drives', tone: TONE.plain };
}

/** What the mode means. */
export function describeMode(display) {
  if (!display) return '–';
  return display.mode === 'mobile' ? 'mobile: it walks' : 'stationary: it stays';
}

/** How far the recording is. */
export function describeRecording(display) {
  const progress = display?.progress;
  if (!progress) return { text: 'not recording', tone: TONE.plain };
  const mark = progress.success ? ' · ★' : '';
  const pause = progress.paused ? ' · over' : '';
  return {
    text: `episode ${progress.episode} · ${formatTime(progress.seconds)}${pause}${mark}`,
    tone: progress.success ? TONE.good : TONE.plain,
  };
}

/** How old what the robot does is. */
export function describeDelay(display) {
  const delay = display?.delay_ms;
  if (delay === null || delay === undefined) return { text: '–', tone: TONE.plain };
  const [slow, bad] = SLOW_MS;
  const tone = delay > bad ? TONE.bad : delay > slow ? TONE.warn : TONE.good;
  return { text: `${Math.round(delay)} ms`, tone };
}

/** Whether somebody's poses come, and of which limbs. */
export function describeOperator(display) {
  const rate = display?.rate ?? 0;
  if (!(rate > 0)) return { text: 'nobody', tone: TONE.plain };
  const lost = LIMBS.filter((_, i) => !display.tracked?.[i]);
  const seen = lost.length ? `${lost.join(', ')} not seen` : 'all seen';
  return { text: `${seen} · ${Math.round(rate)} Hz`, tone: lost.length ? TONE.warn : TONE.good };
}
