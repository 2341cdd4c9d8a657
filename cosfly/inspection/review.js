// Gathers what was chosen into the file that `cosfly inspect review --decisions` reads. Nothing here makes markup of text.
(() => {
const { file, ...about } = pageData();
const tell = (text) => { byId("state").textContent = text; };

byId("save").addEventListener("click", () => {
  const by = byId("by").value.trim();
  const choices = [];
  let unsaid = 0;
  for (const part of document.querySelectorAll(".choice")) {
    const chosen = part.querySelector("input[type=radio]:checked");
    const reason = part.querySelector(".reason").value.trim();
    if (chosen && reason) choices.push({ folder: part.dataset.folder, verdict: chosen.value, reason });
    else if (chosen) unsaid += 1;
  }
  if (!by) { tell("who decides?"); return; }
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
});
})();
