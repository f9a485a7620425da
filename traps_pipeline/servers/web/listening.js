// What the pages that listen share: what the server put into the page, sending decisions, hearing keys.

const SHOWN = JSON.parse(document.getElementById("shown").textContent);
const field = (name) => document.getElementById(name);

// Send JSON and return what the server says. Throws an Error with its sentence where it refuses.
async function post(path, body) {
  const answer = await fetch(path, {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify(body),
  }).catch(() => {
    throw new Error("The server cannot be reached: nothing was kept. Start it again, then try once more.");
  });
  const read = await answer.json().catch(() => ({ error: `the server said ${answer.status}` }));
  if (!answer.ok) throw new Error(read.error || `the server said ${answer.status}`);
  return read;
}

// Hear keys by name. first: what is tried before, and returns true where the key was meant for it.
function hearKeys(keys, first = () => false) {
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") return document.activeElement.blur();
    if (first(event)) return null;
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input:not([type=range]), textarea, select"))
      return null;
    if ((event.key === " " || event.key === "Enter") && event.target.closest("a, button, summary")) return null;
    const act = keys[event.key];
    if (!act) return null;
    event.preventDefault();
    return act();
  });
  document.documentElement.dataset.ready = "1"; // from here on keys are heard
}
