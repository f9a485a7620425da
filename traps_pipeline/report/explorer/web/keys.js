// Keys by name, heard on the whole page.

// Hear keys. keysOf: returns the actions by key; first: is tried before, and returns true where it took the key.
// A field keeps its keys; a button or link keeps those that press it, so that other keys work after a click on it.
/**
 * @param {() => Record<string, () => any>} keysOf
 * @param {(event: KeyboardEvent) => any} [first]
 */
function hearKeys(keysOf, first = () => false) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (first(event)) return;
    const target = /** @type {Element} */ (event.target);
    if (target.closest("input:not([type=range]), textarea, select")) return;
    if ((event.key === " " || event.key === "Enter") && target.closest("a, button, summary")) return;
    const act = keysOf()[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });
}
