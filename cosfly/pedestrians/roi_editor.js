// The editor of a region of interest. Rings are never changed in place, so that a step back is an older list of them.
(() => {
const data = pageData();
const [NUM_X, NUM_Y] = data.size, STATES = ["occupied", "margin", "unused", "free"];
const BOUNDS = [data.x_min, data.y_min, data.x_min + NUM_X * data.cell, data.y_min + NUM_Y * data.cell];
const COLORS = { outer: "#d69e2e", hole: "#e53e3e", other: "#2b6cb0", chosen: "#d53f8c" };
const MOST_STEPS = 300, MOST_DOTS = 4000, NEAR_PX = 9;
const LABELS = {
  en: {
    title: "region of interest", fit: "Whole map", backdrop: "backdrop", grid: "planning grid", above: "map from above", outer: "New polygon", hole: "New hole",
    close: "Close polygon", undo: "Undo", redo: "Redo", remove: "Remove vertex", discard: "Remove polygon", vertex: "vertex", open: "Open file", save: "Save",
    polygon: "polygon", holeOf: "hole", open_ring: "open", points: "points",
    keys: "Click: vertex. Drag: move. Double click on an edge: new vertex. Wheel: zoom; right drag: pan. Keys: arrows move the vertex by a cell (Shift: ten) or pan; N, B next and previous vertex; " +
      "Space: vertex at the cross; + - zoom; Esc: clear the selection.",
    occupied: "occupied", margin: "safety margin", unused: "free, not used", free: "walkable", in_region: "in the region", walkable: "walkable, in the region", outside: "outside the map", cell: "cell",
    region: "cells in the region", walkable_cells: "walkable cells", components: "components", large: "large enough", largest: "largest", used: "cells used",
    saved: "saved to", unsaved: "not saved", whole: "the whole map: no polygon is closed", few: "a polygon needs three vertices", nowhere: "a hole must begin inside a closed polygon",
    not_saved: "close the open polygon first", drawing: "click to add vertices, then close the polygon", lost: "the server of the editor does not answer; start the editor again", large_file: "the file is too large",
  },
  zh: {
    title: "感兴趣区域", fit: "全图", backdrop: "底图", grid: "规划栅格", above: "俯视图", outer: "新多边形", hole: "新孔洞",
    close: "闭合多边形", undo: "撤销", redo: "重做", remove: "删除顶点", discard: "删除多边形", vertex: "顶点", open: "打开文件", save: "保存",
    polygon: "多边形", holeOf: "孔洞", open_ring: "未闭合", points: "个点",
    keys: "单击：加顶点；拖动：移动；双击边：插入顶点；滚轮：缩放；右键拖动：平移。按键：方向键移动顶点一格（Shift：十格）或平移；N、B 下一个/上一个顶点；空格：在十字处加顶点；+ - 缩放；Esc：取消选择。",
    occupied: "占用", margin: "安全边距", unused: "空闲但未使用", free: "可行走", in_region: "区域内", walkable: "区域内可行走", outside: "地图之外", cell: "栅格",
    region: "区域内栅格", walkable_cells: "可行走栅格", components: "连通块", large: "足够大", largest: "最大", used: "使用的栅格",
    saved: "已保存到", unsaved: "未保存", whole: "整张地图：没有闭合的多边形", few: "多边形至少需要三个顶点", nowhere: "孔洞须从已闭合的多边形内开始",
    not_saved: "请先闭合多边形", drawing: "单击添加顶点，然后闭合多边形", lost: "编辑器服务没有应答：它还在运行吗？", large_file: "文件太大",
  },
};
const state = { rings: [], ring: -1, vertex: -1, kind: "outer", cross: null, answer: data, language: navigator.language.startsWith("zh") ? "zh" : "en", said: ["drawing", ""] };
const steps = { list: [[]], at: 0 };
const layers = { grid: null, cells: null, above: null };
let values = null, marks = null;  // of each cell, north up: grey level of the grid; 0, in the region, walkable
const say = (word) => LABELS[state.language][word] ?? word;

// --- rings -----------------------------------------------------------------------------------------------------------

const openRing = () => state.rings.findIndex((ring) => !ring.closed);
const replaced = (number, ring) => state.rings.map((one, i) => (i === number ? ring : one));
const withPoint = (number, vertex, point) => replaced(number, { ...state.rings[number], points: state.rings[number].points.map((one, i) => (i === vertex ? point : one)) });
const rounded = (point) => point.map((value) => Math.round(value * 1000) / 1000);
function change(rings, ring = state.ring, vertex = state.vertex) {  // a step that can be taken back
  steps.list = [...steps.list.slice(Math.max(0, steps.at + 2 - MOST_STEPS), steps.at + 1), rings];
  steps.at = steps.list.length - 1;
  arrive(rings, ring, vertex);
}
function arrive(rings, ring, vertex) {
  Object.assign(state, { rings, ring: Math.min(ring, rings.length - 1), vertex });
  if (state.ring < 0 || vertex >= rings[state.ring].points.length) state.vertex = -1;
  update();
  ask();
}
function stepTo(at) {
  if (at < 0 || at >= steps.list.length) return;
  steps.at = at;
  arrive(steps.list[at], state.ring, state.vertex);
}
function add(place) {
  const open = openRing(), point = rounded(place);
  if (open >= 0) {
    const ring = state.rings[open];
    change(replaced(open, { ...ring, points: [...ring.points, point] }), open, ring.points.length);
  } else if (state.kind) {
    if (state.kind === "hole" && ownerOf(point) < 0) { tell("nowhere", "", true); return; }
    change([...state.rings, { points: [point], closed: false, hole: state.kind === "hole" }], state.rings.length, 0);
  } else choose(-1, -1);
}
function inside([x, y], points) {
  let odd = false;
  for (let i = 0, j = points.length - 1; i < points.length; j = i, i += 1) {
    const [xi, yi] = points[i], [xj, yj] = points[j];
    if (yi > y !== yj > y && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) odd = !odd;
  }
  return odd;
}
const ownerOf = (point) => state.rings.findIndex((ring) => ring.closed && !ring.hole && inside(point, ring.points));
function close() {
  const open = openRing();
  if (open < 0) return;
  const ring = state.rings[open];
  if (ring.points.length < 3) { tell("few", "", true); return; }
  state.kind = null;
  change(replaced(open, { ...ring, closed: true }), open, -1);
}
function removeVertex() {
  if (state.vertex < 0) return;
  const ring = state.rings[state.ring], points = ring.points.filter((_, i) => i !== state.vertex), least = ring.closed ? 3 : 1;
  if (points.length < least) discard(); else change(replaced(state.ring, { ...ring, points }), state.ring, Math.min(state.vertex, points.length - 1));
}
function discard() { if (state.ring >= 0) change(state.rings.filter((_, i) => i !== state.ring), -1, -1); }
function begin(kind) {
  state.kind = kind;
  tell("drawing");
  update();
}
function choose(ring, vertex) { Object.assign(state, { ring, vertex }); update(); }
function toRoi() {  // closed rings in the file's form: each hole goes with the polygon that holds its first vertex
  const closed = state.rings.filter((ring) => ring.closed), outers = closed.filter((ring) => !ring.hole);
  if (!outers.length) return null;
  const polygons = outers.map((ring) => ({ points_world: ring.points, holes: [] }));
  for (const hole of closed.filter((ring) => ring.hole)) {
    const owner = outers.findIndex((ring) => inside(hole.points[0], ring.points));
    polygons[Math.max(0, owner)].holes.push(hole.points);
  }
  const [{ points_world, holes }, ...others] = polygons;
  const more = { ...(holes.length ? { holes } : {}), ...(others.length ? { polygons: others } : {}) };
  return { description: "edited ROI polygon", map: data.map, axes: data.axes, closed: true, points_world, ...more };
}
function ofRoi(roi) {
  const polygons = roi.points_world.length ? [roi, ...roi.polygons] : roi.polygons;
  return polygons.flatMap((one) => [{ points: one.points_world, closed: true, hole: false }, ...one.holes.map((points) => ({ points, closed: true, hole: true }))]);
}

// --- the server ------------------------------------------------------------------------------------------------------

async function request(name, body = "") {
  let answer;
  try { answer = await fetch(name, { method: "POST", body }); } catch { throw new Error(say("lost")); }
  if (!answer.ok) throw new Error((await answer.json().catch(() => ({ error: answer.statusText }))).error);
  return answer;
}
const attempt = (work) => work().catch((error) => tell("", error.message, true));
let asked = "", waiting = 0, busy = false;
function ask() {  // the cells of what is closed: one request at a time, of the last state
  clearTimeout(waiting);
  waiting = setTimeout(async () => {
    const roi = toRoi(), text = roi ? JSON.stringify(roi) : "";
    if (busy || text === asked) return;
    busy = true;
    asked = text;
    document.body.dataset.asks = "yes";
    try {
      await take(await (await request("cells", text)).json());
      tell(roi ? "" : "whole");
    } catch (error) { layers.cells = marks = null; state.answer = {}; tell("", error.message, true); update(); }
    busy = false;
    delete document.body.dataset.asks;
    ask();
  }, 100);
}
async function take(answer) {
  const bitmap = await createImageBitmap(new Blob([bytesOf(answer.cells)]), { premultiplyAlpha: "none" });
  layers.cells = bitmap;
  marks = pixelsOf(bitmap, 3);
  state.answer = answer;
  update();
}
function pixelsOf(bitmap, channel) {
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  const { data: all } = context.getImageData(0, 0, bitmap.width, bitmap.height), found = new Uint8Array(bitmap.width * bitmap.height);
  for (let i = 0; i < found.length; i += 1) found[i] = all[4 * i + channel];
  return found;
}
function put(roi) {
  state.kind = null;
  change(ofRoi(roi), -1, -1);
}
const openFile = (file) => attempt(async () => {  // refused as the pipeline would refuse it: nothing here changes then
  if (file.size > data.most_bytes) throw new Error(`${file.name}: ${say("large_file")}`);
  const answer = await (await request("open", file)).json();
  put(answer.roi);
  map.redraw();
});
const save = () => attempt(async () => {
  const roi = toRoi();
  if (openRing() >= 0 || !roi) { tell(roi ? "not_saved" : "whole", "", true); return; }
  const answer = await (await request("save", JSON.stringify(roi)).catch((error) => { throw new Error(`${say("unsaved")}: ${error.message}`); })).json();
  tell("saved", answer.saved);
});

// --- what is shown ---------------------------------------------------------------------------------------------------

function paint() {
  const backdrop = byId("backdrop").value;
  if (layers.grid) map.picture(layers.grid, BOUNDS);
  if (backdrop === "above" && layers.above) map.picture(layers.above, BOUNDS, true);
  if (layers.cells && state.rings.some((ring) => ring.closed)) map.picture(layers.cells, BOUNDS);
  const first = state.rings.findIndex((ring) => !ring.hole);
  state.rings.forEach((ring, number) => {
    const color = ring.hole ? COLORS.hole : number === first ? COLORS.outer : COLORS.other;
    map.line(ring.points, "#fffc", number === state.ring ? 5 : 4, [], ring.closed);
    map.line(ring.points, color, number === state.ring ? 3 : 2, ring.closed ? [] : [7, 4], ring.closed);
    if (ring.points.length < MOST_DOTS || map.scale > 8) for (const point of ring.points) if (isSeen(point)) map.dot(point, 4.5, color);
  });
  if (state.vertex >= 0) map.dot(state.rings[state.ring].points[state.vertex], 7, COLORS.chosen);
  if (state.cross) for (const [dx, dy] of [[12, 0], [0, 12]]) { const [px, py] = map.at(map.center); map.line([map.place([px - dx, py - dy]), map.place([px + dx, py + dy])], COLORS.chosen, 1.5); }
}
function isSeen(point) { const [px, py] = map.at(point); return px > -9 && py > -9 && px < map.size[0] + 9 && py < map.size[1] + 9; }
function tell(word, more = "", isBad = false) {
  state.said = [word, more];
  byId("message").className = isBad ? "rejected" : word === "saved" ? "accepted" : "";
  byId("message").textContent = [word && say(word), more].filter(Boolean).join(" ");
}
function update() {
  for (const node of document.querySelectorAll("[data-say]")) node.textContent = say(node.dataset.say);
  for (const one of byId("backdrop").options) one.textContent = say(one.value);
  document.documentElement.lang = state.language;
  byId("language").textContent = state.language === "en" ? "ZH" : "EN";
  const open = openRing(), drawn = state.rings.length, chosen = state.ring >= 0 ? state.rings[state.ring] : null;
  byId("close").disabled = open < 0;
  byId("outer").disabled = byId("hole").disabled = open >= 0;
  byId("undo").disabled = steps.at === 0;
  byId("redo").disabled = steps.at === steps.list.length - 1;
  byId("remove").disabled = state.vertex < 0;
  byId("discard").disabled = !chosen;
  const first = state.rings.findIndex((ring) => !ring.hole);
  show("rings", ...state.rings.map((ring, number) => {
    const row = make("button", { type: "button", role: "option", "aria-selected": number === state.ring ? "true" : "false" },
      `${say(ring.hole ? "holeOf" : "polygon")} ${number + 1} · ${ring.points.length} ${say("points")}${ring.closed ? "" : ` · ${say("open_ring")}`}`);
    row.style.setProperty("--own", ring.hole ? COLORS.hole : number === first ? COLORS.outer : COLORS.other);
    row.addEventListener("click", () => choose(number, state.vertex >= 0 && number === state.ring ? state.vertex : 0));
    return row;
  }));
  byId("vertex").hidden = state.vertex < 0;
  if (state.vertex >= 0) {
    byId("which").textContent = `${state.vertex + 1} / ${chosen.points.length}`;
    [byId("x").value, byId("y").value] = chosen.points[state.vertex];
  }
  const figures = state.answer.figures, number = (value) => value.toLocaleString("en");
  const rows = figures ? [
    ["region", figures.region === null ? "–" : number(figures.region)], ["walkable_cells", number(figures.walkable)], ["components", `${number(figures.components)} (${number(figures.large)} ${say("large")})`],
    ["largest", number(figures.largest)], ["used", number(figures.used)],
  ] : [];
  show("figures", ...rows.map(([name, value]) => make("tr", {}, make("td", {}, say(name)), make("td", { class: "n", id: `figure-${name}` }, value))));
  document.body.dataset.rings = drawn;
  map.redraw();
}
function readout(place) {
  const column = Math.floor((place[0] - data.x_min) / data.cell), row = Math.floor((place[1] - data.y_min) / data.cell);
  let what = say("outside");
  if (values && column >= 0 && row >= 0 && column < NUM_X && row < NUM_Y) {
    const at = (NUM_Y - 1 - row) * NUM_X + column, mark = marks && toRoi() ? data.alphas.indexOf(marks[at]) : -1;
    what = `${say("cell")} ${column}, ${row}: ${say(STATES[data.levels.indexOf(values[at])])}${mark < 0 ? "" : `, ${say(["in_region", "walkable"][mark])}`}`;
  }
  byId("cursor").textContent = `x ${place[0].toFixed(2)} m, y ${place[1].toFixed(2)} m · ${what}`;
}

// --- mouse and keys --------------------------------------------------------------------------------------------------

const board = byId("map"), map = new MapCanvas(board, BOUNDS, paint);
function vertexAt(pixel) {
  let best = [NEAR_PX, -1, -1];
  state.rings.forEach((ring, number) => ring.points.forEach((point, vertex) => {
    const [px, py] = map.at(point), away = Math.hypot(px - pixel[0], py - pixel[1]);
    if (away < best[0]) best = [away, number, vertex];
  }));
  return best.slice(1);
}
function edgeAt([px, py]) {  // the ring, and the vertex that a new one on the edge comes after
  let best = [NEAR_PX, -1, -1];
  state.rings.forEach((ring, number) => ring.points.forEach((point, vertex) => {
    if (!ring.closed && vertex === ring.points.length - 1) return;
    const [ax, ay] = map.at(point), [bx, by] = map.at(ring.points[(vertex + 1) % ring.points.length]), length = (bx - ax) ** 2 + (by - ay) ** 2 || 1;
    const share = Math.min(1, Math.max(0, ((px - ax) * (bx - ax) + (py - ay) * (by - ay)) / length)), away = Math.hypot(ax + share * (bx - ax) - px, ay + share * (by - ay) - py);
    if (away < best[0]) best = [away, number, vertex];
  }));
  return best.slice(1);
}
board.addEventListener("pointerdown", (event) => {
  if (event.button !== 0) return;
  state.cross = null;
  const [ring, vertex] = vertexAt(map.pixelOf(event)), before = state.rings;
  if (vertex < 0) { if (openRing() >= 0 || state.kind) add(map.placeOf(event)); else choose(edgeAt(map.pixelOf(event))[0], -1); return; }
  const open = openRing();
  if (ring === open && vertex === 0 && state.rings[open].points.length > 2) { close(); return; }
  choose(ring, vertex);
  board.setPointerCapture(event.pointerId);
  const move = (now) => { state.rings = withPoint(ring, vertex, rounded(map.placeOf(now))); map.redraw(); };
  board.addEventListener("pointermove", move);
  board.addEventListener("pointerup", () => {
    board.removeEventListener("pointermove", move);
    const moved = state.rings;
    state.rings = before;
    if (moved !== before) change(moved, ring, vertex);
  }, { once: true });
});
board.addEventListener("dblclick", (event) => {
  const [number, vertex] = edgeAt(map.pixelOf(event));
  if (number < 0 || openRing() >= 0 || vertexAt(map.pixelOf(event))[1] >= 0) return;
  const ring = state.rings[number], points = [...ring.points.slice(0, vertex + 1), rounded(map.placeOf(event)), ...ring.points.slice(vertex + 1)];
  change(replaced(number, { ...ring, points }), number, vertex + 1);
});
board.addEventListener("pointermove", (event) => readout(map.placeOf(event)));
for (const [axis, id] of [[0, "x"], [1, "y"]]) {
  byId(id).addEventListener("change", () => {
    const value = byId(id).valueAsNumber, point = [...state.rings[state.ring].points[state.vertex]];
    if (Number.isFinite(value)) { point[axis] = value; change(withPoint(state.ring, state.vertex, point)); } else update();
  });
}
function arrow(dx, dy, isFar) {
  if (state.vertex >= 0) {
    const by = data.cell * (isFar ? 10 : 1), [x, y] = state.rings[state.ring].points[state.vertex];
    change(withPoint(state.ring, state.vertex, rounded([x + dx * by, y + dy * by])));
  } else {
    state.cross = true;
    map.look([map.center[0] + (dx * (isFar ? 200 : 40)) / map.scale, map.center[1] + (dy * (isFar ? 200 : 40)) / map.scale]);
    readout(map.center);
  }
}
function along(by) {
  if (!state.rings.length) return;
  const ring = Math.max(0, state.ring), count = state.rings[ring].points.length;
  choose(ring, state.vertex < 0 ? 0 : (state.vertex + by + count) % count);
}
const KEYS = {
  p: () => begin("outer"), h: () => begin("hole"), Enter: close, Delete: removeVertex, Backspace: removeVertex, 0: () => map.fit(), "+": () => map.zoom(1.3), "=": () => map.zoom(1.3), "-": () => map.zoom(1 / 1.3),
  n: () => along(1), b: () => along(-1), Escape: () => { state.cross = null; choose(-1, -1); }, " ": () => { state.cross = true; add(map.center); state.vertex = -1; update(); },
  ArrowLeft: (far) => arrow(-1, 0, far), ArrowRight: (far) => arrow(1, 0, far), ArrowUp: (far) => arrow(0, 1, far), ArrowDown: (far) => arrow(0, -1, far),
};
const CONTROL = { z: (shift) => stepTo(steps.at + (shift ? 1 : -1)), y: () => stepTo(steps.at + 1), s: save };
document.addEventListener("keydown", (event) => {
  const isControl = event.ctrlKey || event.metaKey, key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const inField = ["INPUT", "SELECT", "TEXTAREA"].includes(event.target.tagName), onButton = event.target.tagName === "BUTTON" && ["Enter", " "].includes(event.key);
  const work = isControl ? CONTROL[key] : inField || onButton || event.altKey ? null : KEYS[key];
  if (!work) return;
  event.preventDefault();
  work(event.shiftKey);
});
const BUTTONS = {
  fit: () => map.fit(), outer: () => begin("outer"), hole: () => begin("hole"), close, undo: () => stepTo(steps.at - 1), redo: () => stepTo(steps.at + 1), remove: removeVertex, discard, save,
  language: () => { state.language = state.language === "en" ? "zh" : "en"; tell(...state.said); update(); },
};
for (const [id, work] of Object.entries(BUTTONS)) byId(id).addEventListener("click", () => { work(); board.focus(); });
byId("open").addEventListener("change", () => { if (byId("open").files.length) openFile(byId("open").files[0]); byId("open").value = ""; });
byId("backdrop").addEventListener("change", () => attempt(async () => {
  const name = byId("backdrop").value;
  if (name !== "grid" && !layers[name]) layers[name] = await createImageBitmap(await (await request(name)).blob());
  map.redraw();
}));
window.addEventListener("beforeunload", (event) => { if (steps.at > 0 && state.said[0] !== "saved") event.preventDefault(); });

show("backdrop", ...["grid", "above"].map((name) => make("option", { value: name }, name)));
attempt(async () => {
  layers.grid = await createImageBitmap(new Blob([bytesOf(data.grid)]));
  values = pixelsOf(layers.grid, 0);
  await take(data);
  if (data.roi) { state.kind = null; steps.list = [ofRoi(data.roi)]; arrive(steps.list[0], -1, -1); }
  tell(data.roi ? "" : "drawing");
  update();
  board.focus();
  document.body.dataset.ready = "yes";
});
window.editor = { map, marks: () => marks };  // for a console, and for tests
})();
