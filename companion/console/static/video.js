// The video with the map in it: a click is a target, a drag a box.
const DRAG_PX = 8;

export class VideoView {
  constructor($, ask, page, wish) {
    Object.assign(this, { $, ask, page, wish });
    this.canvas = $("video");
    this.context = this.canvas.getContext("2d");
    this.busy = false;
    this.blink = false;
    $("overlay").addEventListener("change", () => { this.wish(); this.paint(); });
    $("share").addEventListener("input", () => this.paint());
    $("stop").addEventListener("click", () => this.order({ do: "stop" }));
    this.canvas.addEventListener("pointerdown", (e) => { this.from = this.at(e); this.canvas.setPointerCapture(e.pointerId); });
    this.canvas.addEventListener("pointermove", (e) => { if (this.from) { this.to = this.at(e); this.paint(); } });
    this.canvas.addEventListener("pointerup", (e) => this.released(this.at(e)));
    setInterval(() => { if (this.mode === "blink") { this.blink = !this.blink; this.paint(); } }, 500);
  }

  get mode() { return this.$("overlay").value; }

  get needsMap() { return ["slider", "blink", "checker"].includes(this.mode); }

  // As wide as the picture is on this screen: what is sent beyond that would be drawn for nobody.
  get widthPx() {
    const stage = this.canvas.parentElement;
    const high = (stage.clientHeight * this.canvas.width) / this.canvas.height;
    return Math.ceil(Math.min(stage.clientWidth, high) * (window.devicePixelRatio || 1));
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    const scale = Math.min(box.width / this.canvas.width, box.height / this.canvas.height);
    const left = (box.width - this.canvas.width * scale) / 2, top = (box.height - this.canvas.height * scale) / 2;
    const share = (v, size) => Math.min(1, Math.max(0, v / (size * scale)));
    return [share(event.clientX - box.left - left, this.canvas.width), share(event.clientY - box.top - top, this.canvas.height)];
  }

  released(to) {
    const from = this.from;
    this.from = this.to = null;
    if (!from || !this.page().about?.control) return;
    const [w, h] = [this.canvas.width, this.canvas.height];
    const dragged = Math.hypot((to[0] - from[0]) * w, (to[1] - from[1]) * h) > DRAG_PX;
    const [left, right] = [from[0], to[0]].sort((a, b) => a - b), [top, bottom] = [from[1], to[1]].sort((a, b) => a - b);
    this.order(dragged ? { do: "box", left, top, right, bottom } : { do: "target", x: to[0], y: to[1] });
  }

  async order(order) {
    const whole = { ...order, exposure_ns: this.head?.exposure_ns };
    dispatchEvent(new CustomEvent("console-order", { detail: whole }));
    const answer = await this.ask("/api/order", whole);
    this.$("video-told").textContent = answer.text;
  }

  async show(buffer) {
    const arrived = Date.now();
    if (this.busy) return; // the next one is newer
    this.busy = true;
    try {
      const size = new DataView(buffer).getUint32(0, true);
      const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
      let offset = 4 + size;
      const parts = head.parts.map((length) => { const part = new Uint8Array(buffer, offset, length); offset += length; return part; });
      const bitmaps = [parts[0], parts[2]].map((p) => (p.length ? createImageBitmap(new Blob([p], { type: "image/jpeg" })) : null));
      this.image = await bitmaps[0];
      this.render = await bitmaps[1];
      this.edges = new Uint16Array(buffer.slice(4 + size + parts[0].length, 4 + size + parts[0].length + parts[1].length));
      this.head = head;
      if (this.canvas.width !== head.image[0] || this.canvas.height !== head.image[1]) [this.canvas.width, this.canvas.height] = head.image;
      this.$("video-note").hidden = true;
      this.paint();
      // Once the screen's next frame, in which it is painted, is done.
      requestAnimationFrame(() => setTimeout(() => this.tellAge(head, arrived)));
      window.consoleMap?.footprint(head.footprint_enu_m);
      window.consoleFrames = (window.consoleFrames ?? 0) + 1;
    } finally { this.busy = false; }
  }

  tellAge(head, arrived) {
    if (head.exposure_utc_ms === null) {
      this.$("video-age").textContent = "a kept frame, the newest before this moment";
      return;
    }
    const shown = Date.now();
    this.$("video-age").textContent = `shown ${Math.round(shown - head.exposure_utc_ms)} ms after its exposure`;
    const { exposure_utc_ms, published_utc_ms, made_utc_ms } = head;
    const detail = { exposure_utc_ms, published_utc_ms, made_utc_ms, arrived_utc_ms: arrived, shown_utc_ms: shown };
    dispatchEvent(new CustomEvent("console-picture", { detail }));
  }

  paint() {
    this.$("share-label").hidden = this.mode !== "slider";
    if (!this.image) return;
    const { context, canvas } = this, { width, height } = canvas;
    context.drawImage(this.image, 0, 0, width, height);
    if (this.mode === "edges") this.paintEdges();
    else if (this.render && this.mode !== "none") this.paintMap(width, height);
    context.lineWidth = 2;
    for (const target of this.page().state?.targets ?? []) this.paintTarget(target);
    if (this.from && this.to) {
      context.strokeStyle = "#ff2fd0";
      context.strokeRect(this.from[0] * width, this.from[1] * height, (this.to[0] - this.from[0]) * width, (this.to[1] - this.from[1]) * height);
    }
  }

  // As one picture of its own: thousands of single rectangles are ten times the processor's work.
  paintEdges() {
    const { width, height } = this.canvas;
    if (this.layer?.width !== width || this.layer.height !== height) {
      this.layer = Object.assign(document.createElement("canvas"), { width, height });
      this.dots = new ImageData(width, height);
      this.drawnEdges = null;
    }
    if (this.drawnEdges !== this.edges) {
      this.drawnEdges = this.edges;
      const pixels = new Uint32Array(this.dots.data.buffer);
      pixels.fill(0);
      const colour = this.head.estimate?.state === "tracking" ? 0xff6eff3d : 0xff20b0ff; // ABGR
      for (let i = 0; i + 1 < this.edges.length; i += 2) {
        const at = this.edges[i + 1] * width + this.edges[i];
        pixels[at] = pixels[at + 1] = colour;
      }
      this.layer.getContext("2d").putImageData(this.dots, 0, 0);
    }
    this.context.drawImage(this.layer, 0, 0);
  }

  paintMap(width, height) {
    const { context } = this;
    context.save();
    context.beginPath();
    if (this.mode === "slider") context.rect((width * this.$("share").value) / 100, 0, width, height);
    else if (this.mode === "blink") context.rect(0, 0, this.blink ? width : 0, height);
    else {
      const side = width / 8;
      for (let y = 0; y * side < height; y += 1) for (let x = y % 2; x < 8; x += 2) context.rect(x * side, y * side, side, side);
    }
    context.clip();
    context.drawImage(this.render, 0, 0, width, height);
    context.restore();
  }

  // Where a target is in this picture is known for the frame that it was located in.
  paintTarget(target) {
    const camera = this.page().state?.vehicle ? this.head?.image : null;
    if (!camera || !target.pixel || Math.abs(target.time_ns - this.head.exposure_ns) > 5e8) return;
    const scale = this.canvas.width / (this.head.width_px ?? this.canvas.width);
    const [u, v] = [target.pixel[0] * scale, target.pixel[1] * scale];
    this.context.strokeStyle = "#ff2fd0";
    this.context.strokeRect(u - 9, v - 9, 18, 18);
    this.context.fillStyle = "#ff2fd0";
    // Of the size that the picture has on the screen, not in itself.
    const px = Math.round((14 * this.canvas.width) / Math.max(this.canvas.getBoundingClientRect().width, 1));
    this.context.font = `bold ${px}px sans-serif`;
    // Beside the mark where there is room for it.
    const left = u + 12 + this.context.measureText(target.name).width > this.canvas.width;
    this.context.textAlign = left ? "right" : "left";
    this.context.fillText(target.name, left ? u - 12 : u + 12, Math.max(v - 8, px));
  }
}
