// The plane of J and Acc: where each model stands, with its intervals, between lines of equal PECS.

const EVERY = "every"; // regime
const PLANE = { width: 620, left: 52, top: 14, bottom: 44, names: 300, line: 17 };

// Positions of labels in a column, as near to their points as `step` apart allows. ys: of the points, from the top.
function spreadLabels(ys, step, top, bottom) {
  const order = ys.map((y, k) => [y, k]).sort((a, b) => a[0] - b[0]);
  const gap = Math.min(step, (bottom - top) / Math.max(1, ys.length - 1));
  const placed = [];
  for (const [y] of order) placed.push(Math.max(y, placed.length ? placed.at(-1) + gap : top));
  for (let k = placed.length - 1, limit = bottom; k >= 0; k--, limit = placed[k + 1] - gap)
    placed[k] = Math.min(placed[k], limit);
  const at = new Array(ys.length);
  order.forEach(([, k], n) => (at[k] = placed[n]));
  return at;
}

async function landscapeView(route) {
  const info = await study();
  const own = info.leaderboard;
  const hasOverall = own.some((row) => row.dataset === "overall");
  const dataset = route.parameters.dataset || (hasOverall || !own.length ? "overall" : own[0].dataset);
  const { regime = info.regimes[0] || EVERY, paper = "" } = route.parameters;
  const here = (row) => row.dataset === dataset && (regime === EVERY || row.regime === regime);
  const has = (row) => row.acc !== null && row.j !== null;
  const points = own.filter(here).filter(has);
  const published = info.published.filter(here).map((row) => ({ ...row, j: row.abs_rec - row.false_abs, of_paper: true }));
  const shown = [...points, ...(paper ? published.filter(has) : [])];
  return {
    title: "PECS landscape",
    body: [
      h(
        "p",
        { class: "lead" },
        "Right means telling voids from controls (J = AbsRec − FalseAbs), up means answering controls correctly. ",
        "Curves join points of equal PECS = Acc × J. Bars are 95 % intervals; the number behind a name is its PECS. Grey: reference rows, which are no models.",
      ),
      h(
        "div",
        { class: "filters" },
        choice(route, "dataset", "Dataset", datasetOptions(info, { overall: true }).filter(([id]) => id in info.titles), {
          empty: null,
          fallback: dataset,
        }),
        choice(route, "regime", "Regime", [...same(info.regimes), [EVERY, "all"]], { empty: null, fallback: regime }),
        toggle(route, "paper", "also the paper's models (hollow)"),
      ),
      shown.length
        ? section(null, plane(info, shown, regime), planeTable(info, shown))
        : section(null, notice(own.some(here) ? "no point: too few answers are decided" : `${NOT_RUN}: no such metrics`)),
    ],
  };
}

function plane(info, rows, regime) {
  const { width, left, top, bottom, names, line } = PLANE;
  const height = Math.max(520, top + bottom + line * rows.length);
  const low = Math.min(0, ...rows.map((row) => row.j_ci_low ?? row.j), ...rows.map((row) => row.j));
  const edge = Math.max(-1, Math.floor(5 * low) / 5);
  const x = (j) => left + ((j - edge) / (1 - edge)) * (width - left);
  const y = (acc) => top + (1 - acc) * (height - top - bottom);
  const ticks = (from, to) => Array.from({ length: Math.round((to - from) * 5) + 1 }, (_, k) => from + k / 5);
  const curve = (pecs) =>
    Array.from({ length: 41 }, (_, k) => pecs + ((1 - pecs) * k) / 40).map((j) => `${x(j).toFixed(1)},${y(pecs / j).toFixed(1)}`);
  const labels = spreadLabels(rows.map((row) => y(row.acc)), line, top + 6, height - bottom);
  const name = (row) => `${row.model}${regime === EVERY ? `, ${row.regime}` : ""}${row.of_paper ? " (paper)" : ""}`;
  return h(
    "div",
    { class: "scroll" },
    s(
      "svg",
      { class: "plane", viewBox: `0 0 ${width + names} ${height}`, role: "img", "aria-label": "PECS landscape; the table below has its numbers" },
      [1, 2, 3, 4, 5, 6, 7, 8, 9].map((tenth) => [
        s("polyline", { class: "contour", points: curve(tenth / 10).join(" ") }),
        s("text", { class: "faint", x: x(1) - 4, y: y(tenth / 10) - 3, "text-anchor": "end" }, (tenth / 10).toFixed(1)),
      ]),
      ticks(0, 1).map((acc) => [
        s("line", { class: "grid", x1: left, x2: width, y1: y(acc), y2: y(acc) }),
        s("text", { class: "faint", x: left - 6, y: y(acc) + 4, "text-anchor": "end" }, acc.toFixed(1)),
      ]),
      ticks(edge, 1).map((j) => s("text", { class: "faint", x: x(j), y: height - bottom + 16, "text-anchor": "middle" }, fraction(j, 1))),
      s("line", { class: "axis", x1: x(0), x2: x(0), y1: y(1), y2: y(0) }),
      s("text", { x: (left + width) / 2, y: height - 6, "text-anchor": "middle" }, "J = AbsRec − FalseAbs"),
      s("text", { transform: `translate(13 ${(top + height - bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, "Acc"),
      rows.map((row, k) =>
        s(
          "a",
          { class: `point ${row.of_paper ? "of-paper" : isReference(info, row.model) ? "reference" : ""}`, href: row.of_paper ? null : address(["model", row.model], { regime: row.regime }), "aria-label": name(row) },
          s("title", null, `${name(row)}: PECS ${fraction(row.pecs)}, Acc ${percent(row.acc)} %, J ${fraction(row.j)}`),
          s("polyline", { class: "leader", points: `${x(row.j)},${y(row.acc)} ${width + 6},${labels[k]} ${width + 12},${labels[k]}` }),
          ends(row, "j").map(([a, b]) => s("line", { class: "interval-bar", x1: x(a), x2: x(b), y1: y(row.acc), y2: y(row.acc) })),
          ends(row, "acc").map(([a, b]) => s("line", { class: "interval-bar", x1: x(row.j), x2: x(row.j), y1: y(a), y2: y(b) })),
          s("circle", { cx: x(row.j), cy: y(row.acc), r: 4.5 }),
          s("text", { x: width + 15, y: labels[k] + 4 }, `${name(row)}  ${fraction(row.pecs)}`),
        ),
      ),
    ),
  );
}

// The interval of a metric, cut to what the plane shows; none where there is none.
function ends(row, field) {
  const [low, high] = [row[`${field}_ci_low`], row[`${field}_ci_high`]];
  if (low === null || low === undefined) return [];
  const cut = (value) => Math.min(1, Math.max(field === "acc" ? 0 : -1, value));
  return [[cut(low), cut(high)]];
}

function planeTable(info, rows) {
  const best = [...rows].sort((a, b) => (b.pecs ?? -1) - (a.pecs ?? -1) || a.model.localeCompare(b.model));
  const sorted = modelsFirst(info, best);
  const columns = [
    { title: "Model" },
    { title: "Regime" },
    ...info.metrics.map(({ title }) => ({ title, number: true })),
  ];
  const cells = sorted.map((row) => [
    row.of_paper ? `${row.model} (paper)` : link(["model", row.model], { regime: row.regime }, row.model),
    row.regime,
    ...info.metrics.map((each) => metric(row, each)),
  ]);
  return table(columns, withHeading(info, sorted, cells), { caption: "The points", name: "landscape", data: sorted });
}
