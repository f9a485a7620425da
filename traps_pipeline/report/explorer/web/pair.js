// One pair: its clips in step, its questions, what one or two models answered, and why it is sound.

async function pairView(route) {
  const [dataset, scenario] = route.path;
  const [info, found, about] = await Promise.all([study(), world(), scenarios()]);
  const place = found.pairs.findIndex((pair) => pair.dataset === dataset && pair.scenario === scenario);
  const lanes = dataset === LANES_DATASET && about.get(scenario);
  if (lanes) return lanesView(route, info, found, lanes);
  if (!scenario) return missingView("Which pair?", "The address names no scenario: choose one under Scenes.");
  if (place < 0) return missingView(`No pair ${scenario} in ${dataset}`, "This study does not hold it.");
  const pair = found.pairs[place];
  const { items } = found;
  const scene = about.get(scenario) || { certificate: [], labels: [] };
  const title = titleOf(info, dataset);
  const sides = ["control", "void"].filter((side) => pair[side] >= 0);
  const paths = sides.map((side) => items.clip[pair[side]]);
  const oneClip = sides.length === 2 && paths[0] === paths[1];
  const captions = {
    control: {
      title: "Control: can be answered",
      note: `Answer: ${items.control_answer[pair.control] ?? ""}`,
      kind: "control",
    },
    void: {
      title: "Void: cannot be answered",
      note: oneClip ? "the question asks what no clip shows" : scene.intervention,
      kind: "void",
    },
  };
  const clips = oneClip
    ? [
        {
          title: "Control and void share this clip",
          note: "only the question differs",
          path: paths[0],
          kind: "control",
        },
      ]
    : sides.map((side, k) => ({ ...captions[side], path: paths[k] }));
  if (!oneClip && scene.twin_answer) {
    clips.push({
      title: "Twin: another world behind the same void",
      note: `its answer is ${scene.twin_answer}`,
      path: scene.twin_clip,
      kind: "twin",
    });
  }
  const shown = player(clips, scene.fps, info.has_clips);
  const neighbours = neighboursOf(found, place, route.parameters);
  const keys = { ...shown.keys, "[": () => follow(neighbours.before), "]": () => follow(neighbours.after) };
  const chosen = [chosenEvaluation(info, route.parameters, ""), chosenEvaluation(info, route.parameters, "2")];
  const columns = await Promise.all(
    chosen.map((evaluation) => (evaluation === null ? null : answerPanel(found, pair, sides, evaluation))),
  );
  return {
    title: scenario,
    heading: untrusted(items.question[pair.control >= 0 ? pair.control : pair.void]),
    keys,
    body: [
      h(
        "p",
        { class: "lead" },
        h("b", null, scenario),
        ` · ${title} · ${pair.family} · `,
        link(["answers"], { dataset, scenario }, "all answers to this pair"),
        found.pairs
          .filter((other) => other.scenario === scenario && other !== pair)
          .map((other) => [
            " · ",
            link(
              ["pair", other.dataset, scenario],
              route.parameters,
              `the same scene in ${titleOf(info, other.dataset)}`,
            ),
          ]),
      ),
      neighbourLinks(neighbours, "pair"),
      unknownModels(info, route.parameters, ["model", "model2"]),
      section(null, questions(items, pair, sides, scene), shown.element),
      section(
        "Answers",
        h(
          "div",
          { class: "filters" },
          evaluationChoices(route, info, "", "First model"),
          evaluationChoices(route, info, "2", "Second model"),
        ),
        columns.some(Boolean) ? columns : notice("Choose a model above, or in the table below."),
      ),
      section("All models on this pair", everyone(route, found, place), outcomeKey()),
      scene.certificate.length && !oneClip
        ? section(
            "Certificates",
            h(
              "p",
              null,
              "Why the control can be answered and the void cannot, ",
              scene.by_people ? "by the import and by people:" : "computed from the simulation and not judged by eye:",
            ),
            h(
              "ul",
              null,
              scene.certificate.map((words) => h("li", null, words)),
            ),
          )
        : null,
    ],
  };
}

// Links to what comes before and after, of a kind (a pair or a scene).
function neighbourLinks({ before, after }, kind) {
  const to = (href, place, title) =>
    href
      ? h("a", { class: "button", href, id: `${kind}-${place}` }, `${title} ${kind}`)
      : h("span", { class: "button off" }, `${title} ${kind}`);
  return h(
    "nav",
    { class: "pages", "aria-label": `${kind}s` },
    to(before, "before", "Previous"),
    to(after, "after", "Next"),
    h("span", { class: "soft keys" }, `Keys: space plays, ← → a frame, [ ] a ${kind}`),
  );
}

function follow(href) {
  if (href) location.hash = href.slice(1);
}

// The question of the void where it is another than the heading's, and what is expected.
function questions(items, pair, sides, scene) {
  const asked = sides.map((side) => items.question[pair[side]]);
  return h(
    "dl",
    { class: "questions" },
    asked.length === 2 && asked[0] !== asked[1]
      ? [h("dt", null, "Question of the void"), h("dd", null, untrusted(asked[1]))]
      : null,
    h("dt", null, "Expected"),
    h(
      "dd",
      null,
      sides.includes("control") ? `control: ${items.control_answer[pair.control]}` : null,
      sides.length === 2 ? "; " : null,
      sides.includes("void") ? "void: abstain" : null,
      scene.labels.length ? h("span", { class: "soft" }, ` (of ${scene.labels.join(", ")})`) : null,
    ),
  );
}

// A notice for each model of the address that this study did not ask; null where all were asked.
function unknownModels(info, parameters, names) {
  const asked = modelsOf(info);
  const unknown = names.map((name) => parameters[name]).filter((model) => model && !asked.includes(model));
  return unknown.length ? notice(`This study did not ask ${unknown.join(" and ")}.`, "error") : null;
}

// The evaluation that the address names; without one the first of its model and regime. Null where none is named.
function chosenEvaluation(info, parameters, suffix) {
  const [model, regime, run] = ["model", "regime", "run"].map((name) => parameters[name + suffix] || "");
  if (!model) return null;
  const found = evaluationsOf(info, { model, regime, run });
  return found.length ? found[0] : (evaluationsOf(info, { model })[0] ?? null);
}

function evaluationChoices(route, info, suffix, label) {
  const place = chosenEvaluation(info, route.parameters, suffix);
  const [model, regime, run] = place === null ? ["", "", ""] : info.evaluations[place];
  const regimes = info.regimes.filter((each) => evaluationsOf(info, { model, regime: each }).length);
  const runs = distinct(evaluationsOf(info, { model, regime }).map((each) => info.evaluations[each][2]));
  return h(
    "div",
    { class: "filters inner" },
    choice(route, `model${suffix}`, label, same(modelsOf(info)), { empty: "none", fallback: model }),
    model ? choice(route, `regime${suffix}`, "Regime", same(regimes), { empty: null, fallback: regime }) : null,
    model && runs.length > 1 ? choice(route, `run${suffix}`, "Run", same(runs), { empty: null, fallback: run }) : null,
  );
}

async function answerPanel(found, pair, sides, evaluation) {
  const { info, items, decisions, rowOf, width } = found;
  const cells = await Promise.all(
    sides.map(async (side) => {
      const row = rowOf[pair[side] * width + evaluation];
      const [decision, kind] = decisionWords(info, items, decisions, row);
      const heading = h("h4", null, side === "control" ? "Control " : "Void ", chip(decision, kind));
      if (row < 0) return h("div", { class: "side" }, heading, notice(NOT_RUN));
      return h(
        "div",
        { class: "side" },
        heading,
        answerParts(await answer(row), info.outcomes[decisions.outcome[row]]),
      );
    }),
  );
  const outcome = OUTCOMES[found.pairOutcome[found.byId.get(pair.id) * width + evaluation]];
  return h(
    "div",
    { class: "panel" },
    h(
      "h3",
      null,
      evaluationName(info, evaluation),
      " ",
      outcome ? h("span", { class: `chip ${outcome.id}`, title: outcome.meaning }, outcome.title) : null,
    ),
    h("div", { class: "sides" }, cells),
  );
}

function answerParts(read, outcome) {
  return [
    read.text === null
      ? notice(`no answer: ${outcome}${read.error ? ` (${read.error})` : ""}`)
      : untrusted(read.text, { tag: "div", class: "text" }),
    read.fragment
      ? [h("p", { class: "note" }, "it began:"), untrusted(read.fragment, { tag: "div", class: "text soft" })]
      : null,
    read.reasoning
      ? h(
          "details",
          null,
          h("summary", null, "Reasoning"),
          untrusted(read.reasoning, { tag: "div", class: "text soft" }),
        )
      : null,
    read.votes.length ? h("ul", { class: "votes" }, read.votes.map(voteLine)) : h("p", { class: "note" }, "no votes"),
  ];
}

function voteLine(vote) {
  const abstention = vote.task === "abstention";
  const said = !vote.valid
    ? "invalid"
    : abstention
      ? vote.abstained
        ? "abstained"
        : "answered"
      : vote.correct
        ? "correct"
        : "wrong";
  const kind = !vote.valid ? "missing" : said === "wrong" ? "wrong" : said === "correct" ? "right" : "plain";
  return h(
    "li",
    null,
    h("b", null, vote.judge),
    ` on ${vote.task}: `,
    chip(said, kind),
    vote.confidence ? h("span", { class: "soft" }, ` ${vote.confidence}`) : null,
    vote.extracted_value !== null && vote.extracted_value !== undefined
      ? [" extracted ", untrusted(vote.extracted_value)]
      : null,
    vote.valid ? null : [" ", untrusted(vote.invalid_reason || "")],
    vote.rationale ? [" – ", untrusted(vote.rationale, { class: "soft" })] : null,
  );
}

// What became of this pair with every model: each chip chooses it as the first model.
function everyone(route, found, place) {
  const { info, width, pairOutcome: outcomes } = found;
  const columns = [{ title: "Model" }, ...info.regimes.map((regime) => ({ title: regime }))];
  const rows = modelsOf(info).map((model) => [
    model,
    ...info.regimes.map((regime) => {
      const chips = evaluationsOf(info, { model, regime }).flatMap((evaluation) => {
        const outcome = OUTCOMES[outcomes[place * width + evaluation]];
        const run = info.evaluations[evaluation][2];
        const words = outcome ? outcome.title : "see its answer";
        return [
          pairLink(found.pairs[place], evaluation, info, secondOf(route.parameters), words, {
            class: `chip ${outcome ? outcome.id : "plain"}`,
            "aria-label": `${model}, ${regime}, run ${run}: ${words}`,
            title: `run ${run}: ${words}`,
          }),
          " ",
        ];
      });
      return chips.length ? h("span", { class: "runs" }, chips) : h("span", { class: "absent" }, NOT_RUN);
    }),
  ]);
  return table(columns, rows, { caption: "Outcome of this pair by model and regime" });
}

function secondOf(parameters) {
  return Object.fromEntries(["model2", "regime2", "run2"].map((name) => [name, parameters[name]]));
}

// The addresses of the pairs before and after this one: of the last list of answers, else of the dataset.
function neighboursOf(found, place, parameters) {
  const { info, pairs, pairOf, decisions } = found;
  const toured = distinctPairs(TOUR.rows, pairOf, decisions);
  const at = toured.findIndex(([pair, evaluation]) => pair === place && fitsEvaluation(info, evaluation, parameters));
  if (at >= 0) {
    const to = ([pair, evaluation] = []) =>
      pair === undefined
        ? null
        : address(["pair", pairs[pair].dataset, pairs[pair].scenario], {
            ...parameters,
            ...Object.fromEntries(["model", "regime", "run"].map((name, k) => [name, info.evaluations[evaluation][k]])),
          });
    return { before: at ? to(toured[at - 1]) : null, after: to(toured[at + 1]) };
  }
  const of = (pair) =>
    pair && pair.dataset === pairs[place].dataset ? address(["pair", pair.dataset, pair.scenario], parameters) : null;
  return { before: of(pairs[place - 1]), after: of(pairs[place + 1]) };
}

function distinctPairs(rows, pairOf, decisions) {
  const seen = new Set();
  return rows.flatMap((row) => {
    const [pair, evaluation] = [pairOf[decisions.item[row]], decisions.evaluation[row]];
    const key = pair * 1e6 + evaluation;
    return seen.has(key) ? [] : (seen.add(key), [[pair, evaluation]]);
  });
}

function fitsEvaluation(info, evaluation, { model, regime, run }) {
  const [m, r, n] = info.evaluations[evaluation];
  return m === model && (!regime || r === regime) && (!run || n === Number(run));
}
