// What the pages that listen share: what the server put into the page, sending decisions, hearing keys.

const SHOWN = JSON.parse(document.getElementById("shown").textContent);
/** @type {(name: string) => any} */
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

// Hear keys and say so. first: what is tried before, and returns true where the key was meant for it.
/**
 * @param {Record<string, () => any>} keys
 * @param {(event: any) => any} [first]
 */
function listen(keys, first = () => false) {
  hearKeys(
    () => keys,
    (event) => {
      if (event.key === "Escape") /** @type {HTMLElement} */ (document.activeElement).blur();
      return event.key === "Escape" || first(event);
    },
  );
  document.documentElement.dataset.ready = "1"; // from here on keys are heard
}
