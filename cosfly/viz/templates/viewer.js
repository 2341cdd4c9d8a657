// Everything foreign is written with textContent or as an attribute of a picture that we encoded; nothing here makes markup of text.
(() => {
const data = pageData();
const FIELDS = { critical_components: ["critical components", "关键要素"], reasoning_trace: ["reasoning", "推理"] };
const LANGUAGES = { en: "English", zh: "Chinese" };
const VIEWS = [["rgb", "colour"], ["depth", "depth, bright is near"], ["segmentation", "instances, the person in red"]];
const NONE = "none";

// --- what is filtered ------------------------------------------------------------------------------------------------

const samples = [];  // {flight, frame: its number among the shown ones}
data.flights.forEach((flight, number) => flight.frames.forEach((_, frame) => samples.push({ flight: number, frame })));
const flightOf = (sample) => data.flights[sample.flight];
const captionOf = (sample) => flightOf(sample).frames[sample.frame].caption;
const ofCaption = (name) => (sample) => { const caption = captionOf(sample); return caption ? caption[name] || NONE : null; };
const FACETS = [
  ["town", "town", (sample) => flightOf(sample).town],
  ["track", "track", (sample) => flightOf(sample).track],
  ["verdict", "verdict", ofCaption("verdict")],
  ["decision", "decision", ofCaption("decision")],
  ["values", "values", (sample) => valuesOf(captionOf(sample))],
  ["repair", "repaired", (sample) => { const caption = captionOf(sample); return caption ? (caption.repair ? "yes" : "no") : null; }],
];
function valuesOf(caption) {
  if (!caption) return null;
  const { values_filled, values_matched, values_contradicted } = caption.values;
  if (values_contradicted) return "contradicted";
  if (values_matched) return "matched";
  return values_filled ? "filled" : "no values";
}
const textOf = (sample) => {
  const flight = flightOf(sample), frame = flight.frames[sample.frame], caption = frame.caption;
  const texts = caption ? Object.values(caption.texts).flatMap((texts) => Object.values(texts)) : [];
  return [flight.name, `frame ${frame.index}`, ...Object.values(frame.facts), ...texts, ...(caption ? Object.values(caption.facts) : [])].join(" ").toLowerCase();
};

const state = { flight: 0, index: null, q: "" };
let matching = [];

function readHash() {
  const given = new URLSearchParams(location.hash.slice(1));
  for (const [name] of FACETS) state[name] = given.get(name) || "";
  state.q = given.get("q") || "";
  const found = data.flights.findIndex((flight) => flight.name === given.get("flight"));
  state.flight = Math.max(0, found);
  state.index = given.has("frame") ? Number(given.get("frame")) : null;
}
function writeHash() {
  const given = new URLSearchParams();
  for (const [name] of FACETS) if (state[name]) given.set(name, state[name]);
  if (state.q) given.set("q", state.q);
  const flight = data.flights[state.flight];
  if (flight) given.set("flight", flight.name);
  if (state.index !== null) given.set("frame", state.index);
  history.replaceState(null, "", `#${given}`);
}

function filter() {
  const q = state.q.toLowerCase();
  matching = samples.filter((sample) => FACETS.every(([name, , value]) => !state[name] || value(sample) === state[name]) && (!q || textOf(sample).includes(q)));
}
const ofFlight = (number) => matching.filter((sample) => sample.flight === number);

function settle() {  // the flight and frame that are shown are among those that match, where any does
  if (!matching.length) { state.index = null; return; }
  let mine = ofFlight(state.flight);
  if (!mine.length) { state.flight = matching[0].flight; mine = ofFlight(state.flight); }
  const indices = mine.map((sample) => flightOf(sample).frames[sample.frame].index);
  if (!indices.includes(state.index)) {
    const wanted = state.index === null ? indices[0] : state.index;
    state.index = indices.reduce((best, one) => (Math.abs(one - wanted) < Math.abs(best - wanted) ? one : best), indices[0]);
  }
}
const current = () => ofFlight(state.flight).find((sample) => flightOf(sample).frames[sample.frame].index === state.index) || null;

// --- parts of the page -----------------------------------------------------------------------------------------------

function drawFilters() {
  const fields = FACETS.flatMap(([name, title, value]) => {
    const counts = new Map();
    for (const sample of samples) { const one = value(sample); if (one !== null) counts.set(one, (counts.get(one) || 0) + 1); }
    if (!counts.size || (counts.size === 1 && counts.has(NONE))) return [];
    const options = [...counts.keys()].sort().map((one) => make("option", { value: one, selected: state[name] === one }, `${words(one)} (${counts.get(one)})`));
    const select = make("select", { name }, make("option", { value: "" }, "all"), ...options);
    select.addEventListener("change", () => { state[name] = select.value; update(); });
    return [make("label", {}, make("span", {}, title), select)];
  });
  const search = make("input", { type: "search", name: "q", value: state.q, placeholder: "words of a caption, a track, a style" });
  search.addEventListener("input", () => { state.q = search.value; update(); });
  const clear = make("button", { type: "button" }, "clear");
  clear.addEventListener("click", () => { for (const [name] of FACETS) state[name] = ""; state.q = ""; drawFilters(); update(); });
  show("filters", ...fields, make("label", { class: "wide" }, make("span", {}, "free text"), search), clear, make("output", { id: "count" }));
}

function drawLead() {
  const frames = data.flights.reduce((sum, flight) => sum + flight.num_frames, 0);
  const captions = data.flights.reduce((sum, flight) => sum + flight.num_captions, 0);
  byId("lead").textContent = `${data.flights.length} tracks with ${frames.toLocaleString("en")} frames and ` +
    `${captions.toLocaleString("en")} windows; ${samples.length.toLocaleString("en")} frames are shown here. Keys: \u2190 \u2192 frame, \u2191 \u2193 track.`;
}

function drawFlights() {
  const counts = new Map();
  for (const sample of matching) counts.set(sample.flight, (counts.get(sample.flight) || 0) + 1);
  const rows = data.flights.map((flight, number) => {
    if (!counts.has(number)) return null;
    const [head, tail] = [flight.name.split("/").slice(0, -2).join("/"), flight.name.split("/").slice(-2).join(" / ")];
    const facts = [flight.track, flight.result, `${[...new Set(flight.fovs_deg)].join(" to ")}\u00b0`].filter(Boolean).join(" \u00b7 ");
    const row = make("button", { type: "button", class: number === state.flight ? "here" : "", "aria-current": number === state.flight },
      make("small", {}, head), make("b", {}, tail), make("small", {}, `${facts} \u00b7 ${counts.get(number)} of ${flight.frames.length} frames`));
    row.addEventListener("click", () => { state.flight = number; state.index = null; update(); });
    return row;
  });
  show("flights", ...(counts.size ? rows : [make("p", { class: "nothing" }, "Nothing matches the filters.")]));
}

function boxOf(box) {  // a frame round the person, with some air, for it may be a few pixels small
  if (!box) return null;
  const node = make("i", {}), percent = (share) => `${(100 * share).toFixed(2)}%`, air = 0.012;
  node.style.left = percent(box[0] - air);
  node.style.top = percent(box[1] - 1.8 * air);
  node.style.width = percent(box[2] - box[0] + 2 * air);
  node.style.height = percent(box[3] - box[1] + 3.6 * air);
  return node;
}

function drawStage(sample) {
  if (!sample) { show("stage", make("p", { class: "nothing" }, "No frame to show.")); return; }
  const flight = flightOf(sample), frame = flight.frames[sample.frame], mine = ofFlight(state.flight), place = mine.indexOf(sample);
  const pictures = VIEWS.map(([view, title]) => make("figure", { class: view },
    frame.pictures[view] ? make("div", { class: "picture" }, make("img", { alt: `${title}, frame ${frame.index}`, src: `data:image/jpeg;base64,${frame.pictures[view]}` }), boxOf(frame.box))
      : make("div", { class: "gone" }, "no picture"),
    make("figcaption", {}, title)));
  const shown = flight.frames.find((one) => one.target_picture);
  if (shown) pictures.push(make("figure", {}, make("img", { alt: "the target", src: `data:image/png;base64,${shown.target_picture}` }), make("figcaption", {}, "the target")));
  const slider = make("input", { type: "range", min: 0, max: Math.max(0, mine.length - 1), value: place, "aria-label": "frame", id: "time" });
  slider.addEventListener("input", () => step(Number(slider.value) - mine.indexOf(current())));
  const back = make("button", { type: "button", "aria-label": "frame before" }, "\u25c0"), on = make("button", { type: "button", "aria-label": "next frame" }, "\u25b6");
  back.addEventListener("click", () => step(-1));
  on.addEventListener("click", () => step(1));
  const [x, y, z, yaw] = frame.drone;
  const away = frame.target ? Math.hypot(x - frame.target[0], y - frame.target[1], z - frame.target[2]) : null;
  const facts = [
    `frame ${frame.index}`, `${frame.time_s.toFixed(1)} s`, ...Object.entries(frame.facts).map(([name, what]) => `${name}: ${words(what)}`),
    away === null ? "no target" : `${away.toFixed(1)} m to the person, ${(z - frame.target[2]).toFixed(1)} m above the hip`,
    frame.visibility === null ? null : `${Math.round(100 * frame.visibility)} % visible`, `yaw ${yaw.toFixed(0)}\u00b0`,
    frame.is_perturbed ? `perturbed${frame.events ? ": " + Object.entries(frame.events).map(([name, what]) => `${name} ${what}`).join("; ") : ""}` : null,
  ].filter(Boolean);
  show("stage", make("h2", { id: "where" }, flight.name), make("div", { class: "pictures" }, ...pictures),
    make("div", { class: "time" }, back, slider, on, make("span", {}, `${place + 1} / ${mine.length}`)),
    make("ul", { class: "facts" }, ...facts.map((fact) => make("li", {}, fact))));
}

const KIND_COLORS = { Buildings: "--house", Walls: "--house", Vegetation: "--plant", Roads: "--card", Sidewalks: "--card", Terrain: "--card", Ground: "--card", RoadLines: "--card" };
const map = new MapCanvas(byId("plan"), [0, 0, 1, 1], () => {});
function drawMap(sample) {
  const flight = data.flights[state.flight], both = flight ? data.flights.filter((one) => one.group === flight.group && one !== flight) : [];
  const points = flight ? [flight, ...both].flatMap((one) => [...one.drone_path, ...one.target_path]) : [];
  byId("plan").hidden = !points.length;
  if (!points.length) { show("key", make("span", { class: "nothing" }, flight ? "No position is known." : "")); return; }
  const xs = points.map((point) => point[0]), ys = points.map((point) => point[1]), margin = 12;
  const bounds = [Math.min(...xs) - margin, Math.min(...ys) - margin, Math.max(...xs) + margin, Math.max(...ys) + margin], side = Math.max(bounds[2] - bounds[0], bounds[3] - bounds[1]);
  const boxes = data.maps[flight.map] || [], color = colorOf, ownColor = color(`--${flight.track}`);
  map.paint = () => {
    for (const box of boxes) map.area(box.corners, color(KIND_COLORS[box.kind] || "--other"));
    for (const one of both) map.line(one.drone_path, color(`--${one.track}`), 2, [4, 3]);
    map.line(flight.target_path, color("--person"));
    map.line(flight.drone_path, ownColor);
    if (!sample) return;
    const frame = flight.frames[sample.frame], [x, y, , yaw] = frame.drone, open = (frame.fov_deg / 360) * Math.PI;
    const away = frame.target ? Math.hypot(x - frame.target[0], y - frame.target[1]) : 0, reach = Math.max(side / 8, (1.25 * away) / Math.max(0.2, Math.cos(open)));
    const ray = (turn) => { const angle = ((yaw + turn) * Math.PI) / 180; return [x + reach * Math.cos(angle), y + reach * Math.sin(angle)]; };
    map.area([[x, y], ray(-frame.fov_deg / 2), ray(frame.fov_deg / 2)], `${color("--accent")}2e`);
    if (frame.target) map.dot(frame.target, 5, color("--person"), color("--card"));
    map.dot([x, y], 5, ownColor, color("--card"));
  };
  byId("plan").setAttribute("aria-label", `map from above, north up: ${boxes.length} boxes, ${both.length + 2} trajectories`);
  if (map.flight === flight) map.redraw();
  else { Object.assign(map, { flight, bounds, moved: false }); map.resize(); }
  const key = [[flight.track, `drone, ${flight.track}`], ...both.map((one) => [`other ${one.track}`, `drone, ${one.track}`]), ["target", "person"]];
  show("key", ...key.map(([name, title]) => make("span", {}, draw("svg", { viewBox: "0 0 20 6", class: "swatch" }, draw("line", { x1: 0, x2: 20, y1: 3, y2: 3, class: name })), title)), make("span", {}, "north up; wheel and right drag"));
}

function drawCaption(sample) {
  const caption = sample && captionOf(sample);
  if (!caption) { show("caption", make("p", { class: "nothing" }, sample ? "This frame has no caption." : "")); return; }
  const tags = [
    caption.verdict && make("span", { class: `tag ${caption.verdict}` }, words(caption.verdict)),
    ...Object.entries(caption.facts).map(([name, what]) => make("span", { class: "tag plain" }, `${name}: ${words(what)}`)),
    caption.dropped && make("span", { class: "tag bad" }, `dropped: ${words(caption.dropped)}`),
  ].filter(Boolean);
  const columns = Object.entries(LANGUAGES).map(([language, title], number) => {
    const texts = caption.texts[language] || {};
    const fields = Object.entries(FIELDS).flatMap(([field, names]) =>
      texts[field] ? [make("h4", {}, names[number]), make("p", {}, texts[field])] : []);
    return make("div", { lang: language === "zh" ? "zh-CN" : "en" }, make("h3", {}, title), ...(fields.length ? fields : [make("p", { class: "nothing" }, "no text")]));
  });
  const values = Object.entries(caption.values).map(([name, count]) => `${name.replace("values_", "")} ${count}`).join(", ");
  show("caption", make("div", { class: "tags" }, ...tags), make("div", { class: "texts" }, ...columns),
    caption.problems.length ? make("ul", { class: "problems" }, ...caption.problems.map((problem) => make("li", {}, problem))) : null,
    make("p", { class: "key" }, `Values (numbers with a unit, relations in slots): ${values}. Nothing else of the text is checked.`));
}

// --- what happens ----------------------------------------------------------------------------------------------------

function update() {
  filter();
  settle();
  const sample = current();
  drawFlights();
  drawStage(sample);
  drawMap(sample);
  drawCaption(sample);
  byId("count").textContent = `${matching.length.toLocaleString("en")} of ${samples.length.toLocaleString("en")} frames`;
  writeHash();
}
function step(by) {
  const mine = ofFlight(state.flight), sample = mine[Math.min(mine.length - 1, Math.max(0, mine.indexOf(current()) + by))];
  if (!sample) return;
  state.index = flightOf(sample).frames[sample.frame].index;
  const held = document.activeElement && document.activeElement.id === "time";
  update();
  if (held) byId("time").focus();
}
function stepFlight(by) {
  const numbers = [...new Set(matching.map((sample) => sample.flight))], place = numbers.indexOf(state.flight) + by;
  if (place < 0 || place >= numbers.length) return;
  state.flight = numbers[place];
  state.index = null;
  update();
  document.querySelector("#flights .here").scrollIntoView({ block: "nearest" });
}
const KEYS = { ArrowLeft: () => step(-1), ArrowRight: () => step(1), ArrowUp: () => stepFlight(-1), ArrowDown: () => stepFlight(1) };
document.addEventListener("keydown", (event) => {
  const inField = ["INPUT", "SELECT"].includes(event.target.tagName);
  if (!inField && KEYS[event.key] && !event.altKey && !event.ctrlKey && !event.metaKey) { event.preventDefault(); KEYS[event.key](); }
});
byId("filters").addEventListener("submit", (event) => event.preventDefault());
window.addEventListener("hashchange", () => { readHash(); drawFilters(); update(); });
readHash();
drawLead();
drawFilters();
update();
document.body.dataset.ready = "yes";
})();
