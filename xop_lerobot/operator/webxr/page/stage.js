// What the wearer sees, in plain WebGL: the robot's picture and below it the words, held before the
// head; around them a floor, where the room itself is not shown.

const VERTEX = `
attribute vec2 corner;
uniform mat4 toClip;
varying vec2 at;
void main() {
  at = vec2(corner.x + 0.5, 0.5 - corner.y);
  gl_Position = toClip * vec4(corner, 0.0, 1.0);
}`;

const PICTURE = `
precision mediump float;
varying vec2 at;
uniform sampler2D image;
void main() { gl_FragColor = texture2D(image, at); }`;

const FLOOR = `
precision highp float;
varying vec2 at;
void main() {
  vec2 metres = (at - 0.5) * 40.0;
  vec2 line = abs(fract(metres - 0.5) - 0.5);
  float near = exp(-length(metres) / 5.0);
  float lit = 1.0 - smoothstep(0.0, 0.02, min(line.x, line.y));
  gl_FragColor = vec4(vec3(0.25, 0.4, 0.55) * lit * near, 0.0);
}`;

const AWAY = 1.5; // distance of picture and words [m]
const WIDTH = 1.3; // of both [m]
const RAISED = 0.12; // middle of the picture over the line of sight [m]
const GAP = 0.02;

function compile(gl, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, 'corner');
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    throw new Error(gl.getProgramInfoLog(program) || 'its shaders do not compile');
  }
  return { program, toClip: gl.getUniformLocation(program, 'toClip') };
}

/** Product of two matrices, 16 numbers by columns. */
export function multiplyMatrices(a, b) {
  const out = new Float32Array(16);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      for (let k = 0; k < 4; k++) out[4 * column + row] += a[4 * k + row] * b[4 * column + k];
    }
  }
  return out;
}

/** A board of width and height [m] that faces the viewer, its middle at (x, y, z). */
function place(width, height, x, y, z) {
  return [width, 0, 0, 0, 0, height, 0, 0, 0, 0, 1, 0, x, y, z, 1];
}

/** Draws into the layer of one session. */
export class Stage {
  /**
   * @param {XRSession} session
   * @param {boolean} seesRoom whether the room is seen around what is drawn
   */
  constructor(session, seesRoom) {
    const canvas = document.createElement('canvas');
    const options = { xrCompatible: true, alpha: true, antialias: true };
    this.gl = canvas.getContext('webgl2', options) ?? canvas.getContext('webgl', options);
    if (!this.gl) throw new Error('the browser has no WebGL');
    this.seesRoom = seesRoom;
    this.session = session;
    this.layer = new XRWebGLLayer(session, this.gl);
    session.updateRenderState({ baseLayer: this.layer });
    this.picture = compile(this.gl, PICTURE);
    this.floor = compile(this.gl, FLOOR);
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const corners = [-0.5, -0.5, 0.5, -0.5, -0.5, 0.5, 0.5, 0.5];
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(corners), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.images = { camera: this.#makeTexture(), words: this.#makeTexture() };
    this.shown = null;
    this.aspect = 0; // height over width of the picture, 0 before the first
    this.hasWords = false;
  }

  #makeTexture() {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const edge of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
      gl.texParameteri(gl.TEXTURE_2D, edge, gl.CLAMP_TO_EDGE);
    }
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    return texture;
  }

  #load(texture, image) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
  }

  /**
   * Draw one frame.
   *
   * @param {XRViewerPose} viewer
   * @param {object} hud see `Headset`
   * @param {string[]} troubles what is wrong with the headset, in words
   */
  draw(viewer, hud, troubles) {
    const { gl, layer } = this;
    if (hud.update(troubles) || !this.hasWords) {
      this.#load(this.images.words, hud.canvas);
      this.hasWords = true;
    }
    if (hud.picture && hud.picture !== this.shown) {
      this.#load(this.images.camera, hud.picture);
      this.shown = hud.picture;
      this.aspect = hud.picture.height / hud.picture.width;
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    if (this.seesRoom) gl.clearColor(0, 0, 0, 0);
    else gl.clearColor(0.02, 0.03, 0.05, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const head = viewer.transform.matrix;
    const tall = WIDTH * this.aspect;
    const words = WIDTH * (hud.canvas.height / hud.canvas.width);
    const below = this.aspect ? RAISED - tall / 2 - GAP - words / 2 : -0.1;
    for (const view of viewer.views) {
      const port = layer.getViewport(view);
      gl.viewport(port.x, port.y, port.width, port.height);
      const toClip = multiplyMatrices(view.projectionMatrix, view.transform.inverse.matrix);
      if (!this.seesRoom) this.#drawFloor(toClip, head);
      const fromHead = multiplyMatrices(toClip, head);
      if (this.aspect) {
        this.#drawImage(this.images.camera, fromHead, place(WIDTH, tall, 0, RAISED, -AWAY));
      }
      this.#drawImage(this.images.words, fromHead, place(WIDTH, words, 0, below, -AWAY));
    }
  }

  #drawFloor(toClip, head) {
    const { gl } = this;
    const [x, z] = [Math.round(head[12]), Math.round(head[14])]; // it goes with the wearer
    const lie = [40, 0, 0, 0, 0, 0, -40, 0, 0, 1, 0, 0, x, 0, z, 1];
    gl.useProgram(this.floor.program);
    gl.uniformMatrix4fv(this.floor.toClip, false, multiplyMatrices(toClip, lie));
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  #drawImage(texture, toClip, board) {
    const { gl } = this;
    gl.useProgram(this.picture.program);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniformMatrix4fv(this.picture.toClip, false, multiplyMatrices(toClip, board));
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}
