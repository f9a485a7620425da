// The leaderboard: the rows of the study's table, beside the paper's.

// How a metric of the study's lists is printed.
const printerOf = ({ unit }) => (unit === "percent" ? percent : fraction);

// A metric with its deviation over runs and its interval below it.
function metric(row, { field, unit }, mark = "") {
  const print = printerOf({ unit });
  if (!row || row[field] === null || row[field] === undefined)
    return row ? [NONE, mark ? ` ${mark}` : null] : h("span", { class: "absent" }, NOT_RUN);
  const low = row[`${field}_ci_low`];
  const spread = row.n_runs > 1 && `${field}_std` in row ? `± ${print(row[`${field}_std`])}` : "";
  const interval = low === null || low === undefined ? "" : `[${print(low)}, ${print(row[`${field}_ci_high`])}]`;
  return [
    h("span", { class: "metric", "data-field": field }, print(row[field])),
    mark ? ` ${mark}` : null,
    spread || interval ? h("span", { class: "interval" }, [interval, spread].filter(Boolean).join(" ")) : null,
  ];
}

function rankOf(row) {
  if (!row || row.rank_low === null) return NONE;
  return row.rank_low === row.rank_high ? String(row.rank_low) : `${row.rank_low}–${row.rank_high}`;
}

async function leaderboardView(route) {
  const info = await study();
  const own = info.leaderboard;
  const ofPaper = info.metrics.filter((each) => each.in_paper);
  const hasOverall = own.some((row) => row.dataset === "overall");
  const dataset = route.parameters.dataset || (hasOverall || !own.length ? "overall" : own[0].dataset);
  const { regime = "", group = "", sort = "pecs", up = "", paper = "" } = route.parameters;
  const groupOf = new Map(info.models.map((model) => [model.id, model.group]));
  const published = new Map(
    info.published.filter((row) => row.dataset === dataset).map((row) => [`${row.model} ${row.regime}`, row]),
  );
  const beside = new Map(
    (dataset === "overall" ? askedOfLanes(info) : []).map((row) => [`${row.model} ${row.regime}`, row]),
  );
  const asked = new Map(own.map((row) => [`${row.model} ${row.regime}`, { model: row.model, regime: row.regime }]));
  const entries = [...asked.values()];
  if (paper) for (const row of published.values()) if (!asked.has(`${row.model} ${row.regime}`)) entries.push(row);
  const here = new Map(own.filter((row) => row.dataset === dataset).map((row) => [`${row.model} ${row.regime}`, row]));
  const shown = entries
    .map(({ model, regime: of }) => ({
      model,
      regime: of,
      own: here.get(`${model} ${of}`),
      paper: published.get(`${model} ${of}`),
      twoWay: beside.get(`${model} ${of}`),
    }))
    .filter((row) => (!regime || row.regime === regime) && (!group || groupOf.get(row.model) === group));
  shown.splice(0, shown.length, ...modelsFirst(info, shown.sort(ordering(sort, up, info.regimes))));
  const withPairs = own.length > 0 || !askedOfLanes(info).length;
  const withPaper = shown.some((row) => row.paper);
  const columns = [
    { title: "Model", sort: "model" },
    { title: "Regime", sort: "regime" },
    ...info.metrics.map(({ field, title }) => ({ title, number: true, sort: field, hint: info.legend[title] })),
    { title: "Rank", number: true, hint: "by PECS among the models of a regime; ranks in between are not separable" },
    ...(beside.size
      ? info.two_way_metrics.map(({ title }, k) => ({ title, number: true, group: !k, hint: info.legend[title] }))
      : []),
    ...(withPaper
      ? ofPaper.map(({ field, title }, k) => ({
          title: `Paper: ${title}`,
          number: true,
          sort: `paper_${field}`,
          group: !k,
        }))
      : []),
    { title: "n", number: true, sort: "n_pairs", group: true, hint: info.legend.n },
    { title: "Runs", number: true },
    { title: "Missing", number: true, sort: "n_missing", hint: info.legend.Missing },
    ...info.counts.map(({ field, title }) => ({ title, number: true, sort: field, hint: info.legend[title] })),
  ];
  const [missingMark, incompleteMark, brokenMark] = Object.keys(info.marks);
  const markOf = (row) => (row ? (row.incomplete ? incompleteMark : "") + (row.is_broken ? brokenMark : "") : "");
  const rows = shown.map((row) => [
    row.own || asked.has(`${row.model} ${row.regime}`)
      ? link(["model", row.model], { regime: row.regime, dataset: dataset === "overall" ? "" : dataset }, row.model)
      : row.model,
    h("span", { class: "tag" }, row.regime),
    ...info.metrics.map((each) =>
      metric(row.own, each, each.field === "pecs" ? markOf(row.own) : ""),
    ),
    rankOf(row.own),
    ...(beside.size ? info.two_way_metrics.map((each) => metric(row.twoWay, each)) : []),
    ...(withPaper
      ? ofPaper.map((each) =>
          row.paper ? h("span", { title: `epoch ${row.paper.epoch}` }, printerOf(each)(row.paper[each.field])) : NONE,
        )
      : []),
    row.own ? count(row.own.n_pairs) : NONE,
    row.own ? count(row.own.n_runs) : NONE,
    row.own ? `${count(row.own.n_missing)}${row.own.n_missing ? ` ${missingMark}` : ""}` : NONE,
    ...info.counts.map(({ field, unit }) => {
      const value = row.own?.[field] ?? null;
      return value === null ? NONE : unit === "percent" ? percent(value) : count(value);
    }),
  ]);
  const change = (by, down) => route.change({ sort: by === "pecs" ? "" : by, up: down ? "" : "1" });
  const models = distinct(own.map((row) => row.model));
  const known = new Set(info.published.map((row) => row.model));
  const inPaper = models.filter((model) => known.has(model)).length;
  return {
    title: "Leaderboard",
    body: [
      info.shortfall ? notice(info.shortfall, "error") : null,
      h(
        "p",
        { class: "lead" },
        "Each pair has a control, which can be answered, and a void, which cannot. ",
        "PECS rewards models that answer the one and abstain on the other. ",
        "Choose a model to see its answers. ",
        info.provenance,
      ),
      withPairs &&
        h(
          "div",
          { class: "filters" },
          choice(
            route,
            "dataset",
            "Dataset",
            datasetOptions(info, { overall: true }).filter(([id]) => id in info.titles),
            { empty: null, fallback: dataset },
          ),
          choice(
            route,
            "regime",
            "Regime",
            same(distinct([...info.regimes, ...(paper ? info.published.map((row) => row.regime) : [])])),
          ),
          choice(route, "group", "Models", same(distinct(entries.map((row) => groupOf.get(row.model))).sort())),
          toggle(route, "paper", "also the paper's other models"),
        ),
      withPairs &&
        section(
          null,
          table(columns, withHeading(info, shown, rows), {
            caption: `${info.titles[dataset] || dataset}: ${counted(shown.length, "entry", "entries")}`,
            name: "leaderboard",
            order: { by: sort, down: !up },
            sortBy: change,
            data: shown.map(({ own: row, paper: printed, model, regime: of }) => ({
              model,
              regime: of,
              ...(row || {}),
              ...Object.fromEntries(ofPaper.map(({ field }) => [`paper_${field}`, printed?.[field] ?? null])),
            })),
            foot: own.length ? [rowOfPeople(info, dataset, columns)] : [],
            absent: own.length ? "no entry fits these filters" : `${NOT_RUN}: this study has no leaderboard yet`,
          }),
          notes(info, shown, dataset),
          own.length
            ? info.said.map((text) => h("p", { class: "note" }, `${text[0].toUpperCase()}${text.slice(1)}.`))
            : null,
          inPaper
            ? null
            : h("p", { class: "note" }, own.length ? "No model of this study is in the paper's tables." : null),
        ),
      twoWaySection(info),
      meanings(info),
    ],
  };
}

// The row of people, below all models: nobody ranks it.
function rowOfPeople(info, dataset, columns) {
  const row = info.people.find((each) => each.dataset === dataset);
  const cells = [
    "People",
    h("span", { class: "tag" }, "no prompt"),
    ...info.metrics.map((each) => metric(row && row[each.field] !== null ? row : undefined, each)),
    NONE,
  ];
  const rest = columns
    .slice(cells.length)
    .map(({ title }) => (title === "n" && row ? counted(row.n_clips, "clip") : NONE));
  return [...cells, ...rest];
}

function ordering(sort, up, regimes) {
  const valueOf = (row) => {
    if (sort === "model") return row.model;
    if (sort === "regime") return regimes.indexOf(row.regime);
    const found = sort.startsWith("paper_") ? row.paper?.[sort.slice(6)] : row.own?.[sort];
    return found ?? null;
  };
  return (left, right) => {
    const [a, b] = [valueOf(left), valueOf(right)];
    if ((a === null) !== (b === null)) return a === null ? 1 : -1; // without a metric: last, in either direction
    const by = a === b ? 0 : (a < b ? -1 : 1) * (up ? 1 : -1);
    const ofPaper = a === null ? (right.paper?.pecs ?? -1) - (left.paper?.pecs ?? -1) : 0;
    return (
      by ||
      ofPaper ||
      left.model.localeCompare(right.model) ||
      regimes.indexOf(left.regime) - regimes.indexOf(right.regime)
    );
  };
}

function notes(info, shown, dataset) {
  const marked = ["n_missing", "incomplete", "is_broken"].map((field) => shown.some((row) => row.own?.[field]));
  const used = Object.entries(info.marks)
    .filter((_, k) => marked[k])
    .map((entry) => entry.join(" "));
  if (dataset === "overall" && shown.some((row) => !row.own))
    used.push(`${NOT_RUN}: this study did not ask the model, or not on all four datasets`);
  used.push(
    "Brackets: 95 % interval, Bayesian bootstrap over scenarios with one unseen. ±: population standard deviation over runs.",
  );
  return used.map((text) => h("p", { class: "note" }, text));
}

function meanings(info) {
  const terms = Object.entries(info.legend);
  return terms.length
    ? h(
        "details",
        null,
        h("summary", null, "What the columns mean"),
        h(
          "dl",
          { class: "legend" },
          terms.map(([term, meaning]) => [h("dt", null, term), h("dd", null, meaning)]),
        ),
      )
    : null;
}
