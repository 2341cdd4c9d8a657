// A map in 3D with walks and flights over it, played back, with the planning matrix, the rendered frames and the planners' figures.
(() => {
const data = pageData();
const TRACK_COLORS = ["#2b6cb0", "#d97706", "#2f855a", "#9f3fb5", "#0e9f9f", "#c53030", "#6b7a0f", "#7c5a3a"], PERSON = "#e0409a", FIELDS = 10;
const kinds = data.kinds.map((kind) => ({ ...kind, shown: true }));
const shows = [...new Set(data.tracks.map((track) => track.kind))].map((name, number) => ({ name, color: TRACK_COLORS[number % TRACK_COLORS.length], shown: true }));
const tracks = data.tracks.map((track) => ({ ...track, rows: floatsOf(track.rows), show: shows.find((one) => one.name === track.kind) }));
const walks = data.walks.map((walk) => ({ ...walk, rows: floatsOf(walk.rows) }));
const paths = data.paths.map((path) => ({ ...path, person: true, drone: true }));
const state = { path: paths.length ? 0 : -1, time: 0, plays: false, follows: false, last: 0 };
const rowsOf = (rows, width) => Array.from({ length: rows.length / width }, (_, i) => rows.subarray(i * width, (i + 1) * width));
for (const track of tracks) {
  const all = rowsOf(track.rows, FIELDS);
  Object.assign(track, { all, drone: all.map((row) => row.subarray(1, 4)), person: all.map((row) => row.subarray(6, 9)).filter((place) => Number.isFinite(place[0])) });
}
for (const walk of walks) walk.person = rowsOf(walk.rows, 4).map((row) => row.subarray(1, 4));
const ofPath = (number) => tracks.filter((track) => track.path === number && track.show.shown);
const personOf = (number) => (walks.find((walk) => walk.path === number) || tracks.find((track) => track.path === number) || { person: [] }).person;
const lastTime = () => Math.max(0, ...tracks.filter((track) => track.path === state.path).map((track) => track.all.at(-1)[0]), ...walks.filter((walk) => walk.path === state.path).map((walk) => walk.rows.at(-4)));

// Where somebody is at a time: between two rows, the fields of the first but for places.
function rowAt(track, time) {
  const all = track.all;
  let low = 0, high = all.length - 1;
  while (low < high) { const middle = (low + high + 1) >> 1; if (all[middle][0] <= time) low = middle; else high = middle - 1; }
  const one = all[low], next = all[Math.min(low + 1, all.length - 1)], share = next[0] > one[0] ? Math.min(1, Math.max(0, (time - one[0]) / (next[0] - one[0]))) : 0;
  const between = (k) => [0, 1, 2].map((i) => one[k + i] + share * (next[k + i] - one[k + i]));
  return { index: low, drone: between(1), yaw: one[5], person: between(6), visibility: one[9] };
}

// --- in space and on the matrix --------------------------------------------------------------------------------------

const over = byId("over"), pen = over.getContext("2d");
function strokeOver(places, color, width, dashes = []) {
  pen.beginPath();
  let isDown = false;
  for (const place of places) {
    const at = space.at(place);
    if (at && isDown) pen.lineTo(...at); else if (at) pen.moveTo(...at);
    isDown = Boolean(at);
  }
  Object.assign(pen, { strokeStyle: color, lineWidth: width, lineJoin: "round" });
  pen.setLineDash(dashes);
  pen.stroke();
  pen.setLineDash([]);
}
function dotOver(place, radius, color) {
  const at = space.at(place);
  if (!at) return;
  pen.beginPath();
  pen.arc(...at, radius, 0, 2 * Math.PI);
  Object.assign(pen, { fillStyle: color, strokeStyle: "#fff", lineWidth: 2 });
  pen.fill();
  pen.stroke();
}
const link = (visibility) => (!Number.isFinite(visibility) ? ["#868e96", [2, 4]] : visibility >= 0.5 ? ["#2f9e44", []] : ["#e03131", [6, 5]]);
const drawBoth = (line, dot) => paths.forEach((path, number) => {
  const here = number === state.path, own = ofPath(number);
  if (path.person) line(personOf(number), PERSON, here ? 3.5 : 1.5);
  if (path.drone) for (const track of own) line(track.drone, track.show.color, here ? 3.5 : 1.5);
  if (!here) return;
  for (const track of own) {
    const now = rowAt(track, state.time), known = Number.isFinite(now.person[0]), [color, dashes] = link(now.visibility);
    if (known && path.person && path.drone) line([now.drone, now.person], color, 2, dashes);
    if (path.drone) dot(now.drone, 6, track.show.color);
    if (known && path.person) dot(now.person, 5.5, PERSON);
  }
});
function paintOver() {
  const dense = window.devicePixelRatio || 1, [width, height] = space.size;
  if (over.width !== Math.round(width * dense)) over.width = Math.round(width * dense);
  if (over.height !== Math.round(height * dense)) over.height = Math.round(height * dense);
  pen.setTransform(dense, 0, 0, dense, 0, 0);
  pen.clearRect(0, 0, width, height);
  drawBoth(strokeOver, dotOver);
}
let cells = null;
function paintMatrix(map) {
  if (cells) map.picture(cells, data.matrix.bounds);
  drawBoth((places, color, width, dashes) => map.line(places, color, Math.max(1, width * 0.7), dashes), (place, radius, color) => map.dot(place, radius * 0.8, color));
}
const [low, high] = data.bounds;
const space = new BoxSpace(byId("space"), floatsOf(data.boxes), kinds, data.bounds, () => paintOver());
const matrix = new MapCanvas(byId("matrix"), [low[0], low[1], high[0], high[1]], paintMatrix);
if (!space.gl) { byId("lacks").hidden = false; byId("lacks").textContent = "This browser has no WebGL 2: boxes are not drawn."; }
if (data.matrix) createImageBitmap(new Blob([bytesOf(data.matrix.png)])).then((image) => { cells = image; matrix.redraw(); document.body.dataset.matrix = "yes"; });

// --- panels -----------------------------------------------------------------------------------------------------

const box = (is, work, title) => { const node = make("input", { type: "checkbox", checked: is, "aria-label": title, title }); node.addEventListener("change", () => { work(node.checked); redraw(); }); return node; };
const chip = (color) => { const node = make("i", { class: "chip" }); node.style.background = color; return node; };
function drawKinds() {
  show("kinds", ...kinds.map((kind) => {
    const slider = make("input", { type: "range", min: 0.05, max: 1, step: 0.05, value: kind.opacity, "aria-label": `opacity of ${kind.name}` });
    slider.addEventListener("input", () => { kind.opacity = Number(slider.value); space.redraw(); });
    return make("div", { class: "line" }, box(kind.shown, (is) => { kind.shown = is; }, kind.name), chip(`rgb(${kind.color})`), make("span", {}, `${kind.name} `, make("small", {}, kind.count.toLocaleString("en"))), slider);
  }));
}
function drawPaths() {
  show("legend", ...shows.map((one) => make("div", { class: "line" }, box(one.shown, (is) => { one.shown = is; drawFigures(); drawFrame(); }, one.name), chip(one.color), make("span", {}, words(one.name)))),
    walks.length || tracks.length ? make("div", { class: "line" }, chip(PERSON), make("span", {}, "person")) : null);
  show("paths", ...paths.map((path, number) => {
    const name = make("button", { type: "button" }, path.name);
    name.addEventListener("click", () => choose(number));
    const both = box(path.person && path.drone, (is) => { path.person = path.drone = is; drawPaths(); }, "pair");
    const parts = ["person", "drone"].map((part) => make("label", {}, box(path[part], (is) => { path[part] = is; both.checked = path.person && path.drone; }, part), part));
    return make("div", { class: `line${number === state.path ? " here" : ""}` }, both, name, ...parts);
  }));
}
function drawFigures() {
  const own = ofPath(state.path).filter((track) => Object.keys(track.figures).length);
  if (!own.length) { show("compared"); return; }
  const names = [...new Set(own.flatMap((track) => Object.keys(track.figures)))];
  const head = own.map((track) => { const cell = make("th", { class: "n" }, words(track.kind)); cell.style.setProperty("--own", track.show.color); return cell; });
  const told = (value) => (value === undefined ? "–" : Number(value.toFixed(3)).toLocaleString("en"));
  show("compared", make("table", {}, make("tr", {}, make("th", {}, paths[state.path].name), ...head),
    ...names.map((name) => make("tr", {}, make("td", {}, words(name)), ...own.map((track) => make("td", { class: "n" }, told(track.figures[name])))))));
}
let shownFrames = "";
function drawFrame() {  // the pictures at or before the time
  const found = ofPath(state.path).flatMap((track) => {
    const now = rowAt(track, state.time), indices = Object.keys(track.pictures).map(Number).filter((index) => index <= now.index);
    return indices.length ? [{ track, index: Math.max(...indices), now }] : [];
  });
  const key = found.map(({ track, index }) => `${tracks.indexOf(track)}:${index}`).join();
  if (key === shownFrames) return;
  shownFrames = key;
  show("frame", ...found.map(({ track, index, now }) => make("figure", {}, make("img", { alt: `frame ${index}, ${track.kind}`, src: `data:image/jpeg;base64,${track.pictures[index]}` }),
    make("figcaption", {}, `${words(track.kind)}, frame ${index}${Number.isFinite(now.visibility) ? `, ${Math.round(100 * now.visibility)} % visible` : ""}`))));
}
function redraw() { if (!state.plays || state.follows) space.redraw(state.plays); else paintOver(); matrix.redraw(); }
function setTime(time) {
  state.time = Math.min(lastTime(), Math.max(0, time));
  byId("time").value = state.time;
  byId("now").textContent = `${state.time.toFixed(1)} s`;
  if (state.follows && ofPath(state.path).length) space.look(rowAt(ofPath(state.path)[0], state.time).drone, space.away, state.plays);
  drawFrame();
  redraw();
}
function choose(number) {
  if (number < 0 || number >= paths.length) return;
  state.path = number;
  const places = [...personOf(number), ...ofPath(number).flatMap((track) => track.drone)];
  if (places.length) {
    const xs = places.map((place) => place[0]), ys = places.map((place) => place[1]), air = 15;
    const [west, south, east, north] = [Math.min(...xs) - air, Math.min(...ys) - air, Math.max(...xs) + air, Math.max(...ys) + air];
    matrix.moved = true;
    matrix.fit([west, south, east, north]);
    space.look([(west + east) / 2, (south + north) / 2, low[2]], Math.hypot(east - west, north - south) * 1.1);
  }
  byId("time").max = lastTime();
  drawPaths();
  drawFigures();
  setTime(0);
}
function play(is) {
  state.plays = is;
  byId("play").textContent = is ? "❚❚" : "▶";
  state.last = performance.now();
  if (is) requestAnimationFrame(tick);
}
function tick(now) {
  if (!state.plays) return;
  setTime(state.time + (Math.max(0, now - state.last) / 1000) * Number(byId("speed").value));
  state.last = now;
  if (state.time >= lastTime()) play(false); else requestAnimationFrame(tick);
}
byId("play").addEventListener("click", () => { if (state.time >= lastTime()) setTime(0); play(!state.plays); });
byId("time").addEventListener("input", () => setTime(Number(byId("time").value)));
const KEYS = {
  " ": () => byId("play").click(), ArrowLeft: () => setTime(state.time - 0.5), ArrowRight: () => setTime(state.time + 0.5), ArrowUp: () => choose(state.path - 1), ArrowDown: () => choose(state.path + 1),
  0: () => { space.fit(); matrix.fit(); }, f: () => { state.follows = !state.follows; setTime(state.time); },
};
document.addEventListener("keydown", (event) => {
  if (["INPUT", "SELECT", "BUTTON", "SUMMARY"].includes(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.key]) return;
  event.preventDefault();
  KEYS[event.key]();
});
drawKinds();
drawPaths();
if (paths.length) { choose(0); space.fit(); } else byId("play").disabled = true;
space.after = () => { paintOver(); document.body.dataset.ready = "yes"; };
window.scene = { space, state, kinds };  // for a console, and for tests
})();
