// One model: its metrics, and what became of its pairs, by regime and by family. Every count leads to its answers.

async function modelView(route) {
  const [name] = route.path;
  const [info, found] = await Promise.all([study(), world()]);
  const known = modelsOf(info);
  if (!known.includes(name)) return missingView(`No answers of a model ${name}`, "This study did not ask it.");
  const { regime = "", dataset = "", run = "" } = route.parameters;
  const pairs = pairsOf(found, { dataset });
  const regimes = info.regimes.filter((each) => evaluationsOf(info, { model: name, regime: each }).length);
  const evaluations = evaluationsOf(info, { model: name, regime, run });
  return {
    title: name,
    body: [
      h("p", { class: "lead" }, isReference(info, name) ? "A reference row, no model. " : "", "Each count leads to the answers behind it."),
      h(
        "div",
        { class: "filters" },
        choice(route, "regime", "Regime", same(regimes)),
        choice(route, "dataset", "Dataset", datasetOptions(info)),
        runsOf(info).length > 1 ? choice(route, "run", "Run", same(runsOf(info))) : null,
        link(["compare"], { left: name, leftRegime: regime || regimes[0] }, "Compare it", { class: "button" }),
      ),
      section(
        "What became of its pairs",
        outcomeTable(
          regimes.map((each) => {
            const counts = countOutcomes(found, pairs, evaluationsOf(info, { model: name, regime: each, run }));
            return [each, counts, { model: name, regime: each, dataset, run }];
          }),
          "Regime",
        ),
        outcomeKey(),
      ),
      section(
        `By family${regime ? `, ${regime}` : ""}`,
        outcomeTable(
          found.families.flatMap((family) => {
            const counts = countOutcomes(found, pairsOf(found, { dataset, family }), evaluations);
            return counts.some(Boolean) ? [[family, counts, { model: name, regime, dataset, run, family }]] : [];
          }),
          "Family",
        ),
      ),
      section("Metrics", modelMetrics(info, name, dataset, regime)),
    ],
  };
}

function modelMetrics(info, name, dataset, regime) {
  const fits = (row) =>
    row.model === name && (!dataset || row.dataset === dataset) && (!regime || row.regime === regime);
  const own = info.leaderboard.filter(fits);
  const place = (row) => [info.regimes.indexOf(row.regime), Object.keys(info.titles).indexOf(row.dataset)];
  own.sort((a, b) => place(a)[0] - place(b)[0] || place(a)[1] - place(b)[1]);
  const columns = [
    { title: "Regime" },
    { title: "Dataset" },
    ...info.metrics.map(({ title }) => ({ title, number: true })),
    { title: "n", number: true },
    { title: "Runs", number: true },
    { title: "Missing", number: true },
  ];
  const rows = own.map((row) => [
    row.regime,
    info.titles[row.dataset] || row.dataset,
    ...info.metrics.map((each) => metric(row, each)),
    count(row.n_pairs),
    count(row.n_runs),
    count(row.n_missing),
  ]);
  return table(columns, rows, {
    caption: "Metrics of the leaderboard",
    absent: `${NOT_RUN}: no metrics of this model here`,
  });
}

// Rows of [heading, counts by outcome, filter of the answers behind them].
function outcomeTable(rows, heading) {
  const columns = [
    { title: heading },
    { title: "Pairs", number: true },
    { title: "", class: "wide" },
    ...OUTCOMES.map(({ title, meaning }) => ({ title, number: true, hint: meaning })),
  ];
  const cells = rows.map(([title, counts, filter]) => [
    title,
    count(counts.reduce((sum, value) => sum + value, 0)),
    bar(counts),
    ...counts.map((value, k) =>
      value
        ? link(["answers"], { ...filter, outcome: OUTCOMES[k].id, side: "void" }, count(value), {
            "aria-label": `${value} ${OUTCOMES[k].title}, ${title}`,
          })
        : h("span", { class: "absent" }, "0"),
    ),
  ]);
  return table(columns, cells, { caption: `Outcomes of pairs by ${heading.toLowerCase()}` });
}

function missingView(title, text) {
  return { title, body: [notice(text), h("p", null, link([""], {}, "Back to the leaderboard"))] };
}
