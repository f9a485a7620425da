// A scene of two events: its four clips in step, when boards stand in each, and what was answered to its eight items.

const BOARDS = ["before the event", "before its bench"];

// Clips for the player, with bars below; lane of `scene.lanes`: {name, stands: [from, until] in frames}; of a recording
// also `hides`, when its one board stands where the lane is hidden (`stands`: where it is seen).
function laneClips(scene) {
  return scene.clips.map(({ name, path, hidden }) => ({
    title: clipName(name),
    path,
    kind: "lane-clip",
    below: boardBars(scene, hidden),
  }));
}

function clipName(name) {
  return name === "neither"
    ? "Neither hidden"
    : name === "both"
      ? "Both hidden"
      : `${name === "left" ? "Left" : "Right"} hidden`;
}

// Of each lane a row for either board, filled where it stands, and a line at the frame that is shown. In a hidden lane
// the board before the event stands all the time and the other one comes and goes; in a lane that is seen it is the
// other way round.
function boardBars({ lanes, n_frames: frames, fps }, hidden) {
  const share = (frame) => `${(100 * frame) / frames}%`;
  const now = h("span", { class: "now", style: { left: "0%" } });
  const rows = lanes.flatMap(({ name, stands, hides }, lane) =>
    boardsOf(lanes).map((before, board) => {
      const spans = hidden[lane] === (board === 0) ? (hides ?? [[0, frames]]) : stands;
      const words = spans
        .map(([from, until]) => `${(from / fps).toFixed(1)} to ${(until / fps).toFixed(1)} s`)
        .join(", ");
      const parts = spans.map(([from, until]) =>
        h("span", { class: `stands b${board}`, style: { left: share(from), width: share(until - from) } }),
      );
      const label = `${name} lane, board ${before}: stands ${words || "never"}`;
      return h("span", { class: "track", role: "img", "aria-label": label, title: label }, parts);
    }),
  );
  const names = lanes.map(({ name }) => h("span", null, name));
  const element = h(
    "div",
    { class: boardsOf(lanes).length > 1 ? "boards" : "boards one" },
    h("div", { class: "names", "aria-hidden": "true" }, names),
    h("div", { class: "tracks" }, rows, now),
  );
  return { element, show: (frame) => (now.style.left = share(Math.min(frame, frames - 1) + 0.5)) };
}

function boardsOf([{ hides }]) {
  return hides ? BOARDS.slice(0, 1) : BOARDS;
}

function boardKey({ lanes }) {
  const each = boardsOf(lanes).map((before, board) =>
    h("li", null, h("span", { class: `part b${board}` }), `a board stands ${before}`),
  );
  return h("ul", { class: "key" }, each);
}

async function lanesView(route, info, found, scene) {
  const { scenario_id: scenario } = scene;
  const placed = scene.items.map((item) => ({ ...item, place: found.pairs[found.byId.get(item.pair_id)]?.[item.side] }));
  const items = placed.filter(({ place }) => place >= 0); // a held-out study asks one of them
  const shown = player(laneClips(scene), scene.fps, info.has_clips);
  const around = scenariosAround(found, scenario, route.parameters);
  const chosen = [chosenEvaluation(info, route.parameters, ""), chosenEvaluation(info, route.parameters, "2")];
  const evaluations = distinct(chosen.filter((evaluation) => evaluation !== null));
  const asked = scene.lanes.filter(({ name }) => items.some((item) => item.lane === name));
  const tables = await Promise.all(asked.map(({ name }) => laneTable(found, items, name, evaluations)));
  return {
    title: scenario,
    heading: untrusted(scenario),
    keys: { ...shown.keys, "[": () => follow(around.before), "]": () => follow(around.after) },
    body: [
      h(
        "p",
        { class: "lead" },
        `${titleOf(info, LANES_DATASET)} · ${scene.family} · two events that do not touch; either, both or neither of them is hidden, `,
        "and each is asked about. ",
        link(["answers"], { dataset: LANES_DATASET, scenario }, "All answers to this scene"),
      ),
      scene.certificate ? h("p", null, scene.certificate) : null,
      neighbourLinks(around, "scene"),
      unknownModels(info, route.parameters, ["model", "model2"]),
      section(null, shown.element, boardKey(scene)),
      section(
        counted(items.length, "item"),
        h(
          "div",
          { class: "filters" },
          evaluationChoices(route, info, "", "First model"),
          evaluationChoices(route, info, "2", "Second model"),
        ),
        evaluations.length ? null : notice("Choose a model above, or in the table below, to see its answers."),
        tables,
      ),
      section("All models on this scene", everyoneOnLanes(route, found, scenario, items)),
    ],
  };
}

const LANES_DATASET = "two_events";

// The four items about one lane: what is hidden, what is expected, and what was answered.
async function laneTable(found, items, lane, evaluations) {
  const { info, rowOf, width, decisions } = found;
  const own = items.filter((item) => item.lane === lane);
  const cell = async (item, evaluation) => {
    const row = rowOf[item.place * width + evaluation];
    if (row < 0) return h("span", { class: "absent" }, NOT_RUN);
    const read = await answer(row);
    return h(
      "details",
      { class: "told" },
      h("summary", null, chip(...decisionWords(info, found.items, decisions, row)), " ", excerpt(read, [])),
      answerParts(read, info.outcomes[decisions.outcome[row]]),
    );
  };
  const rows = own.map(async (item) => [
    clipName(item.clip),
    item.side === "void" ? "abstain" : found.items.ground_truth[item.place],
    ...(await Promise.all(evaluations.map((evaluation) => cell(item, evaluation)))),
  ]);
  const columns = ["Clip", "Expected", ...evaluations.map((evaluation) => evaluationName(info, evaluation))];
  return [
    h("h3", null, `Asked about the ${lane} lane: `, untrusted(found.items.question[own[0].place])),
    table(
      columns.map((title) => ({ title })),
      await Promise.all(rows),
      { name: `${lane}_lane` },
    ),
  ];
}

// How many of the eight items each evaluation has right; a chip chooses it as the first model.
function everyoneOnLanes(route, found, scenario, items) {
  const { info, rowOf, width, decisions } = found;
  const isRight = (item, evaluation) => {
    const row = rowOf[item.place * width + evaluation];
    return row >= 0 && decisionWords(info, found.items, decisions, row)[1] === "right";
  };
  const chips = (evaluation) => {
    const right = items.filter((item) => isRight(item, evaluation)).length;
    const asked = items.some((item) => rowOf[item.place * width + evaluation] >= 0);
    const [model, regime, run] = info.evaluations[evaluation];
    const to = { ...secondOf(route.parameters), model, regime, run };
    const attributes = {
      class: `chip ${right === items.length ? "right" : "plain"}`,
      title: `${model}, ${regime}, run ${run}`,
    };
    return asked ? [link(["pair", LANES_DATASET, scenario], to, `${right} of ${items.length}`, attributes), " "] : [];
  };
  const rows = modelsOf(info).map((model) => [
    model,
    ...info.regimes.map((regime) => {
      const each = evaluationsOf(info, { model, regime }).flatMap(chips);
      return each.length ? h("span", { class: "runs" }, each) : h("span", { class: "absent" }, NOT_RUN);
    }),
  ]);
  const columns = ["Model", ...info.regimes].map((title) => ({ title }));
  return table(columns, rows, { caption: "Items of this scene that are right, by model and regime" });
}

// The addresses of the scenes of two events before and after this one.
function scenariosAround(found, scenario, parameters) {
  const of = found.pairs.filter((pair) => pair.dataset === LANES_DATASET).map((pair) => pair.scenario);
  const all = distinct(of);
  const to = (id) => (id ? address(["pair", LANES_DATASET, id], parameters) : null);
  return { before: to(all[all.indexOf(scenario) - 1]), after: to(all[all.indexOf(scenario) + 1]) };
}

// The table of two events: what the study's own table holds, the most specific first.
function twoWaySection(info) {
  const rows = askedOfLanes(info);
  if (!rows.length) return null;
  const columns = info.two_way_table.map(({ title, unit }) => ({ title, number: unit !== "text" }));
  const cells = rows.map((row) =>
    info.two_way_table.map(({ field, unit }) =>
      field === "model"
        ? link(["model", row.model], { regime: row.regime, dataset: LANES_DATASET }, row.model)
        : unit === "text"
          ? h("span", { class: "tag" }, row[field])
          : unit === "count"
            ? count(row[field])
            : metric(row, { field, unit }),
    ),
  );
  const notes = info.two_way_notes.map((text) =>
    h("p", { class: "note" }, `${text[0].toUpperCase()}${text.slice(1)}.`),
  );
  return section("Two events, one of them hidden", table(columns, cells, { name: "two_way", data: rows }), notes);
}

function askedOfLanes(info) {
  return info.two_way.filter((row) => row.n_scenarios);
}
