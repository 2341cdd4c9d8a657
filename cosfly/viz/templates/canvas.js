// A map on a canvas, north up, in metres: the wheel zooms, the right or middle button pans; what is on it is drawn by its page.
class MapCanvas {
  // bounds: [west, south, east, north], m. paint(map): draws; places in pixels by map.at([x, y]).
  constructor(canvas, bounds, paint) {
    Object.assign(this, { canvas, bounds, paint, context: canvas.getContext("2d"), scale: 1, center: [0, 0], size: [1, 1], frames: 0, moved: false });
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(-event.deltaY / 400), this.placeOf(event)); }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 1 && event.button !== 2) return;
      event.preventDefault();
      canvas.setPointerCapture(event.pointerId);
      const begin = [event.clientX, event.clientY], center = [...this.center];
      const move = (now) => this.look([center[0] - (now.clientX - begin[0]) / this.scale, center[1] + (now.clientY - begin[1]) / this.scale]);
      canvas.addEventListener("pointermove", move);
      canvas.addEventListener("pointerup", () => canvas.removeEventListener("pointermove", move), { once: true });
    });
    this.resize();
  }
  resize() {
    const box = this.canvas.getBoundingClientRect(), dense = window.devicePixelRatio || 1;
    if (!box.width || !box.height) return;
    this.size = [box.width, box.height];
    this.dense = dense;
    this.canvas.width = Math.round(box.width * dense);
    this.canvas.height = Math.round(box.height * dense);
    if (this.moved) this.redraw(); else this.fit();
  }
  fit(bounds = this.bounds) {
    const [west, south, east, north] = bounds;
    this.scale = 0.96 * Math.min(this.size[0] / Math.max(east - west, 1e-9), this.size[1] / Math.max(north - south, 1e-9));
    this.center = [(west + east) / 2, (south + north) / 2];
    this.redraw();
  }
  look(center) { this.center = center; this.moved = true; this.redraw(); }
  zoom(by, place = this.center) {  // the place stays where it is
    const scale = Math.min(400, Math.max(this.scale * by, 0.1 * Math.min(...this.size) / Math.max(this.bounds[2] - this.bounds[0], this.bounds[3] - this.bounds[1])));
    const share = this.scale / scale;
    this.scale = scale;
    this.look([place[0] + (this.center[0] - place[0]) * share, place[1] + (this.center[1] - place[1]) * share]);
  }
  at([x, y]) { return [this.size[0] / 2 + (x - this.center[0]) * this.scale, this.size[1] / 2 - (y - this.center[1]) * this.scale]; }
  place([px, py]) { return [this.center[0] + (px - this.size[0] / 2) / this.scale, this.center[1] - (py - this.size[1] / 2) / this.scale]; }
  pixelOf(event) { const box = this.canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; }
  placeOf(event) { return this.place(this.pixelOf(event)); }
  redraw() {
    if (this.waits) return;
    this.waits = true;
    requestAnimationFrame(() => {
      this.waits = false;
      this.frames += 1;
      this.context.setTransform(this.dense, 0, 0, this.dense, 0, 0);
      this.context.clearRect(0, 0, ...this.size);
      this.paint(this);
      this.scaleBar();
    });
  }
  picture(image, [west, south, east, north], smooth = false) {
    const [left, top] = this.at([west, north]), [right, bottom] = this.at([east, south]);
    this.context.imageSmoothingEnabled = smooth;
    this.context.drawImage(image, left, top, right - left, bottom - top);
  }
  path(points, closed = false) {
    const context = this.context;
    context.beginPath();
    let last = [NaN, NaN];
    for (let i = 0; i < points.length; i += 1) {
      const [px, py] = this.at(points[i]);
      if (Math.abs(px - last[0]) + Math.abs(py - last[1]) < 0.7 && i < points.length - 1) continue;  // nobody sees it
      if (i) context.lineTo(px, py); else context.moveTo(px, py);
      last = [px, py];
    }
    if (closed) context.closePath();
  }
  line(points, color, width = 2, dashes = [], closed = false) {
    this.path(points, closed);
    Object.assign(this.context, { strokeStyle: color, lineWidth: width, lineJoin: "round" });
    this.context.setLineDash(dashes);
    this.context.stroke();
    this.context.setLineDash([]);
  }
  area(points, color) { this.path(points, true); this.context.fillStyle = color; this.context.fill(); }
  dot(place, radius, color, edge = "#fff") {
    const [px, py] = this.at(place);
    this.context.beginPath();
    this.context.arc(px, py, radius, 0, 2 * Math.PI);
    Object.assign(this.context, { fillStyle: color, strokeStyle: edge, lineWidth: 1.5 });
    this.context.fill();
    this.context.stroke();
  }
  scaleBar() {
    const most = 130 / this.scale, power = 10 ** Math.floor(Math.log10(most)), metres = power * [5, 2, 1].find((k) => k * power <= most);
    const end = this.size[0] - 14, begin = end - metres * this.scale, y = this.size[1] - 14, context = this.context;
    for (const [color, width] of [["#fff", 5], ["#1a202c", 2]]) {
      Object.assign(context, { strokeStyle: color, lineWidth: width });
      context.beginPath();
      context.moveTo(begin, y);
      context.lineTo(end, y);
      context.stroke();
    }
    Object.assign(context, { font: "12px system-ui, sans-serif", textAlign: "right", fillStyle: "#1a202c", strokeStyle: "#fff", lineWidth: 3 });
    context.strokeText(`${metres} m`, end, y - 6);
    context.fillText(`${metres} m`, end, y - 6);
  }
}
