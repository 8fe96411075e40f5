// Pictures of the robot's cameras: decoded one at a time, and of those that wait only the newest.

/** Decodes what comes, camera by camera. */
export class Pictures {
  /** @param {function(number, ImageBitmap)} show takes the picture of a camera, the head's first */
  constructor(show) {
    this.show = show;
    this.waiting = new Map();
    this.busy = new Set();
    this.shown = 0;
  }

  /** Take a JPEG of a camera. */
  async take(camera, blob) {
    this.waiting.set(camera, blob);
    if (this.busy.has(camera)) return;
    this.busy.add(camera);
    try {
      while (this.waiting.has(camera)) {
        const next = this.waiting.get(camera);
        this.waiting.delete(camera);
        try {
          this.show(camera, await createImageBitmap(next));
          this.shown += 1;
        } catch {
          // A picture that is broken is one less.
        }
      }
    } finally {
      this.busy.delete(camera);
    }
  }
}

/** Draw a picture into a canvas of its size. */
export function paint(canvas, picture) {
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    Object.assign(canvas, { width: picture.width, height: picture.height });
  }
  canvas.getContext('2d').drawImage(picture, 0, 0);
}
