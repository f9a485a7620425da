// Parts that several views share: addresses, controls, bars, tables.

// The address of a view: parts of its path and parameters; empty parameters are left out.
function address(path, parameters = {}) {
  const query = new URLSearchParams(
    Object.entries(parameters).filter(([, value]) => value !== "" && value !== null && value !== undefined),
  );
  return `#/${path.map(encodeURIComponent).join("/")}${[...query].length ? `?${query}` : ""}`;
}

function link(path, parameters, text, attributes = {}) {
  return h("a", { href: address(path, parameters), ...attributes }, text);
}

// A labelled selection that changes one parameter of the address. options: [value, text].
function choice(route, name, label, options, { empty = "all", fallback = "" } = {}) {
  const chosen = route.parameters[name] ?? fallback;
  const all = empty === null ? options : [["", empty], ...options];
  const select = h(
    "select",
    { id: `choice-${name}`, onchange: (event) => route.change({ [name]: event.target.value }) },
    all.map(([value, text]) => h("option", { value, selected: String(value) === String(chosen) }, text)),
  );
  return h("label", { class: "choice" }, h("span", null, label), select);
}

function toggle(route, name, label) {
  const change = (event) => route.change({ [name]: event.target.checked ? "1" : "" });
  return h(
    "label",
    { class: "toggle" },
    h("input", { id: `choice-${name}`, type: "checkbox", checked: Boolean(route.parameters[name]), onchange: change }),
    label,
  );
}

function datasetOptions(info, { overall = false } = {}) {
  return [...(overall ? [["overall", info.titles.overall]] : []), ...info.datasets.map(({ id, title }) => [id, title])];
}

function titleOf(info, dataset) {
  return info.datasets.find(({ id }) => id === dataset).title;
}

// Reference rows are of strategies whose score is known, not of models: they come last, below a heading.
const isReference = (info, model) => info.models.some(({ id, group }) => id === model && group === "reference");
const modelsFirst = (info, items) =>
  [...items].sort((left, right) => Number(isReference(info, left.model)) - Number(isReference(info, right.model)));
function withHeading(info, items, rows) {
  const first = items.findIndex(({ model }) => isReference(info, model));
  return first < 0 ? rows : [...rows.slice(0, first), ["Reference rows"], ...rows.slice(first)];
}

const same = (values) => values.map((value) => [value, value]);
const distinct = (values) => [...new Set(values)];
const modelsOf = (info) => distinct(info.evaluations.map(([model]) => model));
const runsOf = (info) => distinct(info.evaluations.map(([, , run]) => run)).sort((a, b) => a - b);

// A bar of the outcomes of pairs, as wide as its share; its text says the counts.
function bar(counts) {
  const total = counts.reduce((sum, value) => sum + value, 0);
  const words = OUTCOMES.map(({ title }, k) => `${title}: ${counts[k]}`)
    .filter((_, k) => counts[k])
    .join(", ");
  const parts = OUTCOMES.map(({ id }, k) =>
    counts[k] ? h("span", { class: `part ${id}`, style: { flexGrow: counts[k] } }) : null,
  );
  return h(
    "span",
    { class: "bar", role: "img", "aria-label": total ? words : NOT_RUN, title: total ? words : NOT_RUN },
    parts,
  );
}

function outcomeKey() {
  return h(
    "ul",
    { class: "key" },
    OUTCOMES.map(({ id, title, meaning }) =>
      h("li", null, h("span", { class: `part ${id}` }), h("b", null, title), ` ${meaning}`),
    ),
  );
}

// Links to the pages before and after this one; null where there is one page.
function pageLinks(route, page, pages) {
  if (pages < 2) return null;
  const to = (target, text) =>
    target < 1 || target > pages
      ? h("span", { class: "button off" }, text)
      : link([route.name], { ...route.parameters, page: target === 1 ? "" : target }, text, { class: "button" });
  return h(
    "nav",
    { class: "pages", "aria-label": "pages" },
    to(page - 1, "Previous"),
    ` page ${count(page)} of ${count(pages)} `,
    to(page + 1, "Next"),
  );
}

// A table in a box that scrolls, its CSV above it, where keys reach it before all links of the rows. columns: {title, number, sort}; rows: arrays of cells (nodes or texts); the first cell
// heads its row. order: {by, down} and `sortBy` make headings sort. foot: rows below the others, which are never sorted.
// data: rows of numbers for the CSV, where the cells are not all there is.
/**
 * @param {any[]} columns
 * @param {any[][]} rows
 * @param {{caption?: string, order?: any, sortBy?: any, absent?: string, name?: string, foot?: any[], data?: any[]}} [options]
 */
function table(columns, rows, { caption, order, sortBy, absent = NOT_RUN, name = "", foot = [], data = null } = {}) {
  const head = columns.map((column, k) => {
    const sorted = order && order.by === column.sort;
    const direction = sorted ? (order.down ? "descending" : "ascending") : null;
    const title = column.sort
      ? h(
          "button",
          {
            type: "button",
            id: `sort-${column.sort}`,
            class: "sort",
            onclick: () => sortBy(column.sort, sorted ? !order.down : column.number),
          },
          column.title,
          h("span", { "aria-hidden": "true" }, sorted ? (order.down ? " ▾" : " ▴") : ""),
        )
      : column.title;
    return h("th", { scope: "col", class: classes(column, k), "aria-sort": direction, title: column.hint }, title);
  });
  const line = (cells) => {
    const colspan = cells.length < columns.length ? columns.length : null; // of a heading between rows
    return h(
      "tr",
      null,
      cells.map((cell, k) =>
        h(k ? "td" : "th", { scope: k ? null : colspan ? "rowgroup" : "row", colspan, class: classes(columns[k], k) }, cell),
      ),
    );
  };
  const empty = h("tr", null, h("td", { colspan: columns.length, class: "absent" }, absent));
  const whole = h(
    "div",
    { class: "scroll", tabindex: "0", role: "region", "aria-label": caption || "table" },
    h(
      "table",
      { "data-name": name, "aria-label": caption || null },
      h("thead", null, h("tr", null, head)),
      h("tbody", null, rows.length ? rows.map(line) : empty),
      foot.length ? h("tfoot", null, foot.map(line)) : null,
    ),
  );
  const file = `${name || (caption || "table").toLowerCase().replace(/[^a-z0-9]+/g, "_")}.csv`;
  const csv = () => save(file, data ? csvOfRows(data) : csvOfTable(whole));
  const button = rows.length ? h("button", { type: "button", class: "save", onclick: csv }, "CSV") : null;
  return [caption || button ? h("div", { class: "caption" }, h("span", null, caption || ""), button) : null, whole];
}

function csvOfRows(rows) {
  const names = distinct(rows.flatMap((row) => Object.keys(row)));
  return csvOf(names, rows.map((row) => names.map((name) => row[name])));
}

// The cells as they are shown; a column without a heading and text, such as one of bars, is left out.
function csvOfTable(box) {
  const read = (row) => [...row.children].map((cell) => cell.innerText.replace(/\s+/g, " ").trim());
  const [head, ...rows] = [...box.querySelectorAll("thead tr, tbody tr, tfoot tr")].map(read);
  const kept = head.flatMap((title, k) => (title ? [k] : []));
  return csvOf(kept.map((k) => head[k]), rows.map((row) => kept.map((k) => row[k])));
}

function classes(column, place) {
  return [column.number ? "number" : "word", place ? "" : "first", column.group ? "group" : "", column.class || ""]
    .join(" ")
    .trim();
}

function section(title, ...children) {
  return h("section", null, title ? h("h2", null, title) : null, children);
}

function notice(text, kind = "") {
  return h("p", { class: `notice ${kind}`.trim(), role: kind === "error" ? "alert" : null }, text);
}

function evaluationName(info, place) {
  const [model, regime, run] = info.evaluations[place];
  return `${model}, ${regime}, run ${run}`;
}
