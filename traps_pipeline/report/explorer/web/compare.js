// Two models, or two regimes of one: the items in which they differ, and the tests of the report's tables.

const COMPARED = [
  { id: "void_abstention", title: "abstains on the void", side: "void", column: "abstained" },
  { id: "control_abstention", title: "abstains on the control", side: "control", column: "abstained" },
  { id: "correctness", title: "answers the control correctly", side: "control", column: "correct" },
];

// Items decided on both sides: how many have a yes on the left alone, on the right alone, on both, on neither; and why
// they may not be compared, where epochs differ.
function compared(found, left, right, dataset, decision) {
  const { items, width, rowOf, decisions, info } = found;
  const { side, column } = COMPARED.find(({ id }) => id === decision);
  const sides = { both: [], left: [], right: [], neither: [] };
  let refused = "";
  for (let item = 0; item < items.length; item++) {
    if (items.dataset[item] !== dataset || items.side[item] !== side) continue;
    const rows = [left, right].map((evaluation) => rowOf[item * width + evaluation]);
    if (rows[0] < 0 || rows[1] < 0) continue;
    const epochs = rows.map((row) => info.epochs[decisions.epoch[row]]);
    const [a, b] = rows.map((row) => decisions[column][row]);
    if (a > YES || b > YES) continue;
    if (epochs[0] !== epochs[1])
      refused = `epoch ${epochs[0]} against epoch ${epochs[1]}; metrics of different epochs are never put in one contrast`;
    sides[a ? (b ? "both" : "left") : b ? "right" : "neither"].push(item);
  }
  return { ...sides, refused };
}

async function compareView(route) {
  const [info, found, differences, tests] = await Promise.all([study(), world(), contrasts(), regimeTests()]);
  const models = modelsOf(info);
  if (!models.length) return missingView("Compare", `${NOT_RUN}: this study has no answers yet.`);
  const known = (name) => (models.includes(route.parameters[name]) ? route.parameters[name] : undefined);
  const left = known("left") ?? models[0];
  const { decision = "void_abstention", run = "1" } = route.parameters;
  const right = known("right") ?? models.find((model) => model !== left) ?? left;
  const regimesOf = (model) => info.regimes.filter((regime) => evaluationsOf(info, { model, regime }).length);
  const leftRegime = route.parameters.leftRegime || regimesOf(left)[0];
  const rightRegime =
    route.parameters.rightRegime ||
    (right === left ? regimesOf(right).find((r) => r !== leftRegime) : leftRegime) ||
    leftRegime;
  const paired = info.datasets.filter(({ sides, id }) => sides.length === 2 && id in info.titles);
  const dataset = route.parameters.dataset || (paired[0] || { id: "" }).id;
  const places = [
    evaluationsOf(info, { model: left, regime: leftRegime, run })[0],
    evaluationsOf(info, { model: right, regime: rightRegime, run })[0],
  ];
  const ran = places.every((place) => place !== undefined);
  const names = [`${left}, ${leftRegime}`, `${right}, ${rightRegime}`];
  const { title } = COMPARED.find(({ id }) => id === decision) || COMPARED[0];
  return {
    title: "Compare",
    body: [
      unknownModels(info, route.parameters, ["left", "right"]),
      h(
        "div",
        { class: "filters" },
        choice(route, "left", "Left", same(models), { empty: null, fallback: left }),
        choice(route, "leftRegime", "Regime", same(regimesOf(left)), { empty: null, fallback: leftRegime }),
        choice(route, "right", "Right", same(models), { empty: null, fallback: right }),
        choice(route, "rightRegime", "Regime", same(regimesOf(right)), { empty: null, fallback: rightRegime }),
        choice(
          route,
          "dataset",
          "Dataset",
          paired.map(({ id, title: text }) => [id, text]),
          { empty: null, fallback: dataset },
        ),
        choice(
          route,
          "decision",
          "Decision",
          COMPARED.map(({ id, title: text }) => [id, text]),
          { empty: null, fallback: decision },
        ),
        runsOf(info).length > 1
          ? choice(route, "run", "Run", same(runsOf(info)), { empty: null, fallback: run })
          : null,
      ),
      ran
        ? comparison(found, tests, {
            places,
            names,
            dataset,
            decision,
            title,
            run,
            left,
            right,
            leftRegime,
            rightRegime,
          })
        : section(null, notice(`${NOT_RUN}: one side has no run ${run}.`)),
      section(
        "Difference of PECS and J",
        differenceTable(info, differences, { left, right, leftRegime, rightRegime, names }),
      ),
    ],
  };
}

function comparison(
  found,
  tests,
  { places, names, dataset, decision, title, run, left, right, leftRegime, rightRegime },
) {
  const sides = compared(found, ...places, dataset, decision);
  const n = sides.both.length + sides.left.length + sides.right.length + sides.neither.length;
  if (!n) return section(null, notice("No item is decided on both sides."));
  const test =
    left === right
      ? tests.find(
          (row) =>
            row.dataset === dataset &&
            row.model === left &&
            row.run === Number(run) &&
            row.decision === decision &&
            [row.left_regime, row.right_regime].includes(leftRegime) &&
            [row.left_regime, row.right_regime].includes(rightRegime),
        )
      : null;
  const refused = test ? test.refused : sides.refused;
  const p = test ? test.p : mcnemar(sides.left.length, sides.right.length);
  const counts = table(
    [
      { title: `Whether it ${title}` },
      { title: `${names[1]}: yes`, number: true },
      { title: `${names[1]}: no`, number: true },
    ],
    [
      [`${names[0]}: yes`, count(sides.both.length), h("b", null, count(sides.left.length))],
      [`${names[0]}: no`, h("b", null, count(sides.right.length)), count(sides.neither.length)],
    ],
    { caption: `${counted(n, "item")} decided on both sides, run ${run}`, name: "counts" },
  );
  const words = refused
    ? [h("b", null, "not compared: "), refused]
    : [
        `They differ on ${count(sides.left.length + sides.right.length)} of ${counted(n, "item")}: McNemar's exact test gives `,
        h("b", { "data-field": "p" }, `p = ${pValue(p)}`.replace("= <", "<")),
        test && test.p_holm !== null ? `, ${pValue(test.p_holm)} after Holm's correction` : "",
        test ? "." : "; it is not corrected for other comparisons that you make.",
      ];
  const parameters = { model: left, regime: leftRegime, run, model2: right, regime2: rightRegime, run2: run };
  return [
    section("Counts", counts, h("p", { class: "verdict" }, words)),
    h(
      "div",
      { class: "columns" },
      section(`Only ${names[0]} ${title}`, differing(found, sides.left, parameters)),
      section(`Only ${names[1]} ${title}`, differing(found, sides.right, parameters)),
    ),
  ];
}

function differing(found, items, parameters) {
  if (!items.length) return notice("none");
  const pairs = items.map((item) => found.pairs[found.pairOf[item]]);
  return h(
    "ul",
    { class: "pairs" },
    pairs.map((pair) => h("li", null, link(["pair", pair.dataset, pair.scenario], parameters, pair.scenario))),
  );
}

// The rows of the table of contrasts that compare these two, from the left's point of view.
function differenceTable(info, differences, { left, right, leftRegime, rightRegime, names }) {
  const is = (row, end, model, regime) => row[`${end}_model`] === model && row[`${end}_regime`] === regime;
  const rows = differences.flatMap((row) => {
    if (is(row, "left", left, leftRegime) && is(row, "right", right, rightRegime)) return [{ ...row, sign: 1 }];
    return is(row, "right", left, leftRegime) && is(row, "left", right, rightRegime) ? [{ ...row, sign: -1 }] : [];
  });
  const place = (row) => Object.keys(info.titles).indexOf(row.dataset);
  rows.sort((a, b) => place(a) - place(b) || b.metric.localeCompare(a.metric));
  const signed = (row, value) => (value === null ? null : row.sign * value);
  const cells = rows.map((row) => {
    const ends = [row.ci_low, row.ci_high].map((value) => signed(row, value));
    if (row.sign < 0) ends.reverse();
    return [
      info.titles[row.dataset] || row.dataset,
      row.metric.toUpperCase(),
      row.refused ? `not compared: ${row.refused}` : fraction(signed(row, row.difference)),
      row.refused || ends[0] === null ? NONE : `[${fraction(ends[0])}, ${fraction(ends[1])}]`,
      pValue(row.p),
      pValue(row.p_holm),
    ];
  });
  const columns = [
    { title: "Dataset" },
    { title: "Metric" },
    { title: "Difference", number: true },
    { title: "95 % interval", number: true },
    { title: "p", number: true },
    { title: "p (Holm)", number: true },
  ];
  return table(columns, cells, {
    caption: `${names[0]} minus ${names[1]}, over all runs`,
    name: "differences",
    absent:
      "no contrast of these two is in the study's tables: they compare models under one regime, or regimes of one model",
  });
}
