// Cases that the paper describes in words: two answers that show one, side by side. Only decided answers of one run are
// compared.

const CASES = [
  { id: "inverted", title: "Abstains on the control and answers the void" },
  { id: "flipped", title: "Answers a void under standard and abstains on it under guided" },
  { id: "textual", title: "Answers the visual void, and abstains on a question about what no clip shows of the same scene" },
  { id: "thinking", title: "Of two models, one of which reasons, one abstains on the void and the other answers it" },
];

// All cases of a kind: [{pair, left, right}] with the places of a pair and of two evaluations; `other` is the pair of
// the right answer where it is another one.
function casesOf({ info, pairs, width, rowOf, decisions }, kind) {
  const abstains = (item, evaluation) => {
    const row = item < 0 ? -1 : rowOf[item * width + evaluation];
    return row < 0 || decisions.abstained[row] > YES ? null : decisions.abstained[row] === YES;
  };
  const place = new Map(info.evaluations.map((each, k) => [each.join(" "), k]));
  const sets = new Map(pairs.map((pair, p) => [`${pair.dataset} ${pair.scenario}`, p]));
  const partners = new Map(info.reasoning_pairs);
  const found = [];
  pairs.forEach((pair, p) => {
    if (!(pair.dataset in info.titles)) return; // an arm
    info.evaluations.forEach(([model, regime, run], left) => {
      const own = abstains(pair.void, left);
      if (own === null) return;
      if (kind === "inverted" && !own && abstains(pair.control, left)) found.push({ pair: p, left, right: left });
      if (kind === "flipped" && !own && regime === "standard") {
        const right = place.get(`${model} guided ${run}`);
        if (right !== undefined && abstains(pair.void, right)) found.push({ pair: p, left, right });
      }
      if (kind === "textual" && !own && !pair.dataset.endsWith("_ill_posed")) {
        const other = sets.get(`${pair.dataset}_ill_posed ${pair.scenario}`);
        if (other !== undefined && abstains(pairs[other].void, left)) found.push({ pair: p, left, right: left, other });
      }
      if (kind === "thinking" && partners.has(model)) {
        const right = place.get(`${partners.get(model)} ${regime} ${run}`);
        const theirs = right === undefined ? null : abstains(pair.void, right);
        if (theirs !== null && theirs !== own) found.push({ pair: p, left, right });
      }
    });
  });
  return found;
}

const CASES_SHOWN = 50;

async function casesView(route) {
  const [info, found] = await Promise.all([study(), world()]);
  const { kind = CASES[0].id, model = "" } = route.parameters;
  const { title } = CASES.find(({ id }) => id === kind) || CASES[0];
  const all = casesOf(found, kind);
  const models = distinct(all.map(({ left }) => info.evaluations[left][0])).sort();
  const fits = all.filter(({ left }) => !model || info.evaluations[left][0] === model);
  const pages = Math.max(1, Math.ceil(fits.length / CASES_SHOWN));
  const page = Math.min(pages, Math.max(1, Number(route.parameters.page) || 1));
  const line = ({ pair, left, right, other }) => {
    const [, regime2, run2] = info.evaluations[right];
    const second = right === left ? {} : { model2: info.evaluations[right][0], regime2, run2 };
    const shown = found.pairs[pair];
    return [
      pairLink(shown, left, info, second, shown.scenario),
      titleOf(info, shown.dataset),
      evaluationName(info, left),
      other === undefined
        ? right === left ? "" : evaluationName(info, right)
        : pairLink(found.pairs[other], left, info, {}, titleOf(info, found.pairs[other].dataset)),
    ];
  };
  const columns = ["Pair", "Dataset", "Answer", "Second answer"].map((head) => ({ title: head }));
  return {
    title: "Cases",
    body: [
      h("p", { class: "lead" }, "Pairs of this study's own answers that show what the paper describes in words."),
      h(
        "div",
        { class: "filters" },
        choice(route, "kind", "Case", CASES.map(({ id, title: words }) => [id, words]), { empty: null, fallback: kind }),
        choice(route, "model", "Model", same(models)),
      ),
      section(
        `${title}: ${count(fits.length)}`,
        table(columns, fits.slice((page - 1) * CASES_SHOWN, page * CASES_SHOWN).map(line), {
          caption: title,
          name: "cases",
          absent: "none among the judged answers of this study",
          data: fits.map((each) => ({
            kind,
            dataset: found.pairs[each.pair].dataset,
            scenario_id: found.pairs[each.pair].scenario,
            left: evaluationName(info, each.left),
            right: evaluationName(info, each.right),
          })),
        }),
        pageLinks(route, page, pages),
      ),
    ],
  };
}
