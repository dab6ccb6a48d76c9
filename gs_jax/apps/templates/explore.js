// Sliders request an evaluation of the design: one request at a time, and after its answer only the latest one.
"use strict";
(() => {
const at = id => document.getElementById(id), inputs = [...document.querySelectorAll("#sliders input")];
const steps = input => Number(input.max);
const exact = {};
const value = input => exact[input.name] ?? Number(input.dataset.low) + input.value / steps(input) * (input.dataset.high - input.dataset.low);
const values = () => Object.fromEntries(inputs.map(input => [input.name, value(input)]));
const set = (input, number) => {
  exact[input.name] = number;
  input.value = Math.round((number - input.dataset.low) / (input.dataset.high - input.dataset.low) * steps(input));
  say(input);
};
const say = input => {
  const text = `${Number(value(input).toPrecision(4))} mm`;
  at(`${input.name}-said`).textContent = text;
  input.setAttribute("aria-valuetext", text);
};
const ask = async (name, what) => {
  const answer = await fetch(name, {method: "POST", body: JSON.stringify(what)});
  if (!answer.ok) throw new Error(answer.statusText);
  const found = await answer.json();
  if (found.error) throw new Error(found.error);
  for (const [part, html] of Object.entries(found.parts || {})) at(part).innerHTML = html;
  if (found.kept) kept = found.kept;
  return found;
};
let kept = [], busy = false, wanted = false, later = 0;
const failed = error => { at("said").textContent = error.message; };
const move = async () => {
  wanted = true;
  at("said").textContent = "";  // at the start: what is said while the answer is awaited must stay
  if (busy) return;
  busy = true;
  while (wanted) {
    wanted = false;
    try {
      const began = performance.now(), found = await ask("move", values());
      at("time").textContent = `${found.ms} ms`;
      at("time").dataset.ms = found.ms;
      at("time").dataset.whole = Math.round(performance.now() - began);
    } catch (error) { if (!wanted) failed(error); }
  }
  busy = false;
  clearTimeout(later);
  at("small").classList.add("busy");
  later = setTimeout(reconstruct, 400);
};
let slow = false;
const reconstruct = async () => {
  if (slow) { later = setTimeout(reconstruct, 200); return; }
  slow = true;
  const asked = JSON.stringify(values());
  try { await ask("reconstruct", values()); } catch (error) { failed(error); }
  slow = false;
  if (asked === JSON.stringify(values())) at("small").classList.remove("busy");
};
for (const input of inputs) {
  set(input, Number(input.dataset.start));
  input.addEventListener("input", () => { delete exact[input.name]; say(input); move(); });
}
const back = numbers => { for (const input of inputs) set(input, numbers[input.name]); move(); };
at("reset").addEventListener("click", () => back(Object.fromEntries(inputs.map(i => [i.name, Number(i.dataset.start)]))));
at("keep").addEventListener("click", () => ask("keep", values()).then(move, failed));
at("save").addEventListener("click", () => ask("save", values()).then(found => { at("said").textContent = found.said; }, failed));
at("history").addEventListener("click", event => {
  const row = event.target.dataset.kept;
  if (row !== undefined) back(kept[row]);
});
ask("history", {}).then(move, failed);
})();
