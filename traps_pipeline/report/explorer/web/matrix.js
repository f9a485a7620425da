// Families against models: what became of their pairs.

async function matrixView(route) {
  const [info, found] = await Promise.all([study(), world()]);
  const regime = route.parameters.regime ?? (info.regimes[0] || "");
  const { dataset = "", run = "", outcome = "confabulated", group = "" } = route.parameters;
  const groupOf = new Map(info.models.map((model) => [model.id, model.group]));
  const fits = ({ model }) => !group || groupOf.get(model) === group;
  const models = modelsFirst(info, modelsOf(info).map((model) => ({ model })).filter(fits))
    .map(({ model }) => model)
    .filter((model) => evaluationsOf(info, { model, regime, run }).length);
  const which = Math.max(
    0,
    OUTCOMES.findIndex(({ id }) => id === outcome),
  );
  const evaluations = models.map((model) => evaluationsOf(info, { model, regime, run }));
  const rows = found.families.flatMap((family) => {
    const pairs = pairsOf(found, { dataset, family });
    const counts = evaluations.map((each) => countOutcomes(found, pairs, each));
    if (!counts.some((each) => each.some(Boolean))) return [];
    return [
      [family, ...counts.map((each, k) => matrixCell(each, which, { model: models[k], regime, dataset, run, family }))],
    ];
  });
  return {
    title: "Families × models",
    body: [
      h(
        "p",
        { class: "lead" },
        "Each cell is a family of scenes and a model: the bar shows what became of its pairs, the number is the share of ",
        h("b", null, OUTCOMES[which].title.toLowerCase()),
        `: ${OUTCOMES[which].meaning}.`,
      ),
      h(
        "div",
        { class: "filters" },
        choice(
          route,
          "outcome",
          "Number",
          OUTCOMES.map(({ id, title }) => [id, title]),
          { empty: null, fallback: outcome },
        ),
        choice(route, "regime", "Regime", same(info.regimes), { empty: null, fallback: regime }),
        choice(route, "dataset", "Dataset", datasetOptions(info)),
        runsOf(info).length > 1 ? choice(route, "run", "Run", same(runsOf(info))) : null,
        choice(route, "group", "Models", same(distinct(modelsOf(info).map((model) => groupOf.get(model))).sort())),
      ),
      section(
        null,
        table(
          [
            { title: "Family" },
            ...models.map((model) => ({ title: link(["model", model], { regime, dataset }, model), class: "matrix" })),
          ],
          rows,
          {
            caption: "Outcomes of pairs by family and model",
            absent: `${NOT_RUN}: no answers fit these filters`,
            name: "matrix",
          },
        ),
        outcomeKey(),
      ),
    ],
  };
}

function matrixCell(counts, which, filter) {
  const total = counts.reduce((sum, value) => sum + value, 0);
  if (!total) return h("span", { class: "absent" }, NOT_RUN);
  const undecided = counts[MISSING] === total && which !== MISSING;
  const share = undecided ? NONE : `${percent(counts[which] / total, 0)}\u00a0%`;
  return h(
    "a",
    {
      class: "cell",
      href: address(["answers"], { ...filter, outcome: OUTCOMES[which].id, side: "void" }),
      title: `${counts[which]} of ${counted(total, "pair")}`,
    },
    bar(counts),
    h("span", { class: "share" }, share),
  );
}
