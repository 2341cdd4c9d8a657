// Gathers what was chosen into the file that `cosfly inspect review --decisions` reads; a flight is decided by a key.
(() => {
const { file, ...about } = pageData();
const parts = [...document.querySelectorAll(".choice")], last = {};  // verdict: the last reason given for it
if (!parts.length) return;
let here = -1;
const tell = (text) => { byId("state").textContent = text; };
const chosenOf = (part) => part.querySelector("input[type=radio]:checked");
const reasonOf = (part) => part.querySelector(".reason");
const count = () => tell(`${parts.filter(chosenOf).length} of ${parts.length} decided`);

function go(to) {
  if (to < 0 || to >= parts.length) return;
  for (const part of parts) part.closest("details").classList.toggle("here", part === parts[to]);
  here = to;
  const card = parts[to].closest("details");
  card.open = true;
  card.scrollIntoView({ block: "nearest" });
}
function decide(verdict) {
  if (here < 0) return;
  const part = parts[here], reason = reasonOf(part);
  part.querySelector(`input[value=${verdict}]`).checked = true;
  if (!reason.value.trim() && last[verdict]) reason.value = last[verdict];
  count();
  if (reason.value.trim()) next(); else reason.focus();
}
function next() {
  const part = parts[here], chosen = chosenOf(part);
  if (chosen && reasonOf(part).value.trim()) last[chosen.value] = reasonOf(part).value.trim();
  document.activeElement.blur();
  const open = parts.findIndex((one, number) => number > here && !chosenOf(one));
  go(open >= 0 ? open : here + 1);
}
function leaveOpen() {
  if (here >= 0 && chosenOf(parts[here])) chosenOf(parts[here]).checked = false;
  count();
}
function save() {
  const by = byId("by").value.trim();
  const choices = [];
  let unsaid = 0;
  for (const part of parts) {
    const chosen = chosenOf(part), reason = reasonOf(part).value.trim();
    if (chosen && reason) choices.push({ folder: part.dataset.folder, verdict: chosen.value, reason });
    else if (chosen) unsaid += 1;
  }
  if (!by) { tell("who decides?"); byId("by").focus(); return; }
  if (unsaid) { tell(`${unsaid} decisions without a reason`); return; }
  if (!choices.length) { tell("nothing is decided yet"); return; }
  const text = JSON.stringify({ ...about, by, choices }, null, 1) + "\n";
  const shown = byId("text");
  shown.value = text;
  shown.hidden = false;
  const link = make("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  link.download = file;
  link.click();
  tell(`${choices.length} decisions in ${file}, and below`);
}
const KEYS = { j: () => go(here + 1), k: () => go(here - 1), a: () => decide("accepted"), r: () => decide("rejected"), u: leaveOpen, s: save };
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.classList.contains("reason") && event.key === "Enter") { here = parts.indexOf(event.target.closest(".choice")); next(); return; }
  const inText = event.target.tagName === "TEXTAREA" || (event.target.tagName === "INPUT" && event.target.type !== "radio");
  if (inText || !KEYS[event.key.toLowerCase()]) return;
  event.preventDefault();
  KEYS[event.key.toLowerCase()]();
});
for (const part of parts) part.addEventListener("change", count);
byId("save").addEventListener("click", save);
go(0);
})();
