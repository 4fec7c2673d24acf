// Draws sets of Gaussians into two pictures, and mixes the pictures on the canvas.

class Renderer {
  /** `onOrder` is called when a set has been sorted anew. */
  constructor(canvas, onOrder) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error("This page needs WebGL 2, which this browser does not offer.");
    this.gl = gl;
    this.canvas = canvas;
    // Many faint layers add up: 8 bits per layer would show.
    const floats = gl.getExtension("EXT_color_buffer_float")
      || gl.getExtension("EXT_color_buffer_half_float");
    this.pictureFormat = floats ? gl.RGBA16F : gl.RGBA8;
    this.gaussians = this.program(GAUSSIAN_VERTEX, GAUSSIAN_FRAGMENT);
    this.mixture = this.program(PICTURE_VERTEX, PICTURE_FRAGMENT);
    this.pictures = [0, 1].map(() => ({ buffer: gl.createFramebuffer(), shown: "" }));
    this.corners = gl.createBuffer();
    this.sets = [];
    this.sorter = startSorter(({ id, order, forward }) => {
      this.takeOrder(this.sets[id], order, forward);
      this.sets[id].waiting = false;
      onOrder();
    });
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      throw new Error(`The shaders do not compile here: ${gl.getProgramInfoLog(program)}`);
    }
    const uniforms = {}, count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < count; i++) {
      const { name } = gl.getActiveUniform(program, i);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  texture(inner, width, height, format, type, values) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, inner, width, height, 0, format, type, values);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  /** Upload the Gaussians of a run; each period then draws some of them. */
  addGaussians({ count, geometry, sh }) {
    const gl = this.gl, height = Math.max(1, Math.ceil(count / PER_ROW));
    const filled = (array, per) => {
      const whole = new array.constructor(height * PER_ROW * per);
      whole.set(array);
      return whole;
    };
    return {
      geometry: this.texture(gl.RGBA32F, 4 * PER_ROW, height, gl.RGBA, gl.FLOAT,
        filled(geometry, PER_GEOMETRY)),
      sh: this.texture(gl.RGBA8UI, 15 * PER_ROW, height, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE,
        filled(sh, PER_SH)),
    };
  }

  /** Add what one period shows. */
  addSet(textures, centres, members, options) {
    const set = { ...options, textures, centres, members, id: this.sets.length };
    this.sorter.postMessage({ id: set.id, centres, members });
    this.sets.push(set);
    this.makeQuads(members.length);
    return set;
  }

  /** Make the triangles of so many squares. An instance for each would be slower. */
  makeQuads(count) {
    const gl = this.gl, corners = new Uint32Array(6 * count);
    if (count <= (this.quads || 0)) return;
    for (let i = 0; i < count; i++) corners.set([0, 1, 2, 2, 1, 3].map(k => 4 * i + k), 6 * i);
    this.quads = count;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  }

  takeOrder(set, order, forward) {
    const gl = this.gl, height = Math.max(1, Math.ceil(order.length / ORDER_ROW));
    const whole = new Uint32Array(height * ORDER_ROW);
    whole.set(order);
    gl.deleteTexture(set.order || null);
    set.order = this.texture(
      gl.R32UI, ORDER_ROW, height, gl.RED_INTEGER, gl.UNSIGNED_INT, whole);
    set.forward = forward;
    set.sorted = (set.sorted || 0) + 1;
  }

  /** See that a set is sorted for a direction: at once, or soon by the worker. */
  sort(set, forward, atOnce) {
    if (set.forward && dot(set.forward, forward) > 0.999999) return;
    if (atOnce || !set.forward) {
      this.takeOrder(set, sortByDepth(set.centres, set.members, forward), forward);
    } else if (!set.waiting) {
      set.waiting = true;
      this.sorter.postMessage({ id: set.id, forward });
    }
  }

  resize(width, height) {
    const gl = this.gl, { canvas } = this;
    if (canvas.width === width && canvas.height === height && this.pictures[0].texture) return;
    [canvas.width, canvas.height] = [width, height];
    const type = this.pictureFormat === gl.RGBA16F ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE;
    for (const picture of this.pictures) {
      gl.deleteTexture(picture.texture || null);
      picture.texture = this.texture(this.pictureFormat, width, height, gl.RGBA, type, null);
      picture.shown = "";
      gl.bindFramebuffer(gl.FRAMEBUFFER, picture.buffer);
      gl.framebufferTexture2D(
        gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture.texture, 0);
    }
  }

  /** Draw a set into a picture, unless it shows just that. */
  drawPicture(picture, set, view, atOnce) {
    const gl = this.gl, { width, height } = this.canvas, K = pixelsOf(view.camera, width, height);
    this.sort(set, row(view.rotation, 2), atOnce);
    const shown = JSON.stringify([set.id, set.sorted, view.eye, view.rotation, K]);
    if (picture.shown === shown) return;
    picture.shown = shown;
    const { program, uniforms } = this.gaussians;
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture.buffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.bindTextures(uniforms, { ...set.textures, order: set.order });
    gl.uniformMatrix3fv(uniforms.rotation, true, view.rotation);
    gl.uniform3fv(uniforms.eye, view.eye);
    gl.uniform2f(uniforms.focal, K.fx, K.fy);
    gl.uniform2f(uniforms.middle, K.cx, K.cy);
    gl.uniform2f(uniforms.size, width, height);
    gl.uniform1f(uniforms.near, set.near);
    gl.uniform1i(uniforms.antialiased, set.antialiased ? 1 : 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.drawElements(gl.TRIANGLES, 6 * set.members.length, gl.UNSIGNED_INT, 0);
  }

  bindTextures(uniforms, textures) {
    Object.entries(textures).forEach(([name, texture], unit) => {
      this.gl.activeTexture(this.gl.TEXTURE0 + unit);
      this.gl.bindTexture(this.gl.TEXTURE_2D, texture);
      this.gl.uniform1i(uniforms[name], unit);
    });
  }

  /** Show a mixture of the sets: {first, second, share, wipe}, wipe as a share of the width. */
  draw(mixture, view, atOnce = false) {
    const gl = this.gl, { first, second, share, wipe } = mixture, [a, b] = this.pictures;
    const both = second !== first && (wipe !== null || share > 0);
    this.drawPicture(a, first, view, atOnce);
    if (both) this.drawPicture(b, second, view, atOnce);
    const { program, uniforms } = this.mixture;
    gl.useProgram(program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.disable(gl.BLEND);
    this.bindTextures(uniforms, { first: a.texture, second: (both ? b : a).texture });
    gl.uniform1f(uniforms.share, both ? share : 0);
    gl.uniform1f(uniforms.wipe, both && wipe !== null ? wipe * this.canvas.width : -1);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Pixels of the canvas after `draw`, in the same task: RGBA, the lowest row first. */
  readPixels() {
    const gl = this.gl, { width, height } = this.canvas, pixels = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return pixels;
  }
}
