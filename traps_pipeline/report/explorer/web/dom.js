// Elements. Text of a study only ever becomes text nodes: nothing here parses markup.

// An element. attributes: properties (class, href, value ...), `on...` listeners, `style` as an object; null and false
// are left out. children: nodes, texts, arrays of them; null and false are left out.
function h(tag, attributes, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "style") Object.assign(element.style, value);
    else if (name in PROPERTIES) element[PROPERTIES[name]] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  return add(element, children);
}

const PROPERTIES = { value: "value", checked: "checked", selected: "selected", muted: "muted" };

function add(element, children) {
  for (const child of children.flat(Infinity)) {
    if (child === null || child === undefined || child === false) continue;
    element.append(child instanceof Node ? child : visible(child));
  }
  return element;
}

// Characters that nobody sees and that change how others are shown: controls, zero-width and bidirectional ones. What
// belongs to an emoji is none of them: its variation selector, and the joiner before the next one.
const HIDDEN = new RegExp(
  "(?![\\t\\n]|\\r\\n)" +
    "(?!(?<=[\\p{Extended_Pictographic}0-9#*])\\ufe0f)" +
    "(?!(?<=[\\p{Extended_Pictographic}\\p{Emoji_Modifier}\\ufe0f])\\u200d\\p{Extended_Pictographic})" +
    "[\\p{Cc}\\p{Default_Ignorable_Code_Point}\\u2028\\u2029\\ufff9-\\ufffb]",
  "gu",
);

const numbered = (character) => `U+${character.codePointAt(0).toString(16).toUpperCase().padStart(4, "0")}`;

// A text with each hidden character as [U+202E]: for what is no element of its own. As `escape_invisible` in base/terminal.py.
function visible(text) {
  return String(text).replace(HIDDEN, (character) => `[${numbered(character)}]`);
}

// A text that somebody else wrote, in an element of its own that isolates its direction. A hidden character is shown
// by its number, so that a reader sees what was said. terms: words to mark, in lower case.
/**
 * @param {any} text
 * @param {{tag?: string, terms?: string[], [attribute: string]: any}} [options]
 */
function untrusted(text, { tag = "span", terms = [], ...attributes } = {}) {
  const element = h(tag, { dir: "auto", ...attributes, class: `untrusted ${attributes.class || ""}`.trim() });
  const whole = String(text);
  let from = 0;
  for (const match of whole.matchAll(HIDDEN)) {
    add(element, marked(whole.slice(from, match.index), terms));
    element.append(h("span", { class: "hidden-character", title: "a character that is not seen" }, numbered(match[0])));
    from = match.index + match[0].length;
  }
  return add(element, marked(whole.slice(from), terms));
}

function marked(text, terms) {
  return terms.length ? markedParts(text, terms).map(([part, hit]) => (hit ? h("mark", null, part) : part)) : [text];
}

// An element of a drawing, as `h`.
function s(tag, attributes, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes || {}))
    if (value !== null && value !== undefined) element.setAttribute(name, value);
  return add(element, children);
}

// Do something after what stands now was painted, so that reading files does not hold it up.
function afterPaint(act) {
  requestAnimationFrame(() => setTimeout(act));
}
