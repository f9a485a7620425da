// All answers: filters over decisions, search in the texts.

const PAGE_ROWS = 25;
const DECISIONS = [
  ["correct", "correct"],
  ["wrong", "wrong"],
  ["abstained", "abstained"],
  ["answered", "answered"],
  ["undecided", "undecided"],
  ["unjudged", "no text (refused, empty, failed)"],
];

// The rows of the answers that fit the filters, in order.
function fittingRows(found, filter) {
  const { info, items, pairs, pairOf, rowOf, width, decisions, pairOutcome: outcomes } = found;
  const { dataset = "", family = "", side = "", scenario = "", outcome = "", decision = "", split = "" } = filter;
  const evaluations = evaluationsOf(info, filter);
  const wanted = OUTCOMES.findIndex(({ id }) => id === outcome);
  const judged = info.outcomes.map((each) => info.judged.includes(each));
  const rows = [];
  for (let item = 0; item < items.length; item++) {
    const pair = pairs[pairOf[item]];
    if ((dataset && pair.dataset !== dataset) || (family && pair.family !== family)) continue;
    if ((side && items.side[item] !== side) || (scenario && pair.scenario !== scenario)) continue;
    const isControl = items.side[item] === "control";
    for (const evaluation of evaluations) {
      const row = rowOf[item * width + evaluation];
      if (row < 0) continue;
      if (outcome && outcomes[pairOf[item] * width + evaluation] !== wanted) continue;
      if (split && (decisions.unanimous[row] || !judged[decisions.outcome[row]])) continue;
      if (decision && !isDecided(decisions, row, isControl, judged, decision)) continue;
      rows.push(row);
    }
  }
  return rows;
}

function isDecided(decisions, row, isControl, judged, decision) {
  if (!judged[decisions.outcome[row]]) return decision === "unjudged";
  const [abstained, correct] = [decisions.abstained[row], decisions.correct[row]];
  if (decision === "undecided") return abstained > YES || (isControl && correct > YES);
  if (decision === "abstained") return abstained === YES;
  if (decision === "answered") return abstained === NO;
  if (decision === "correct") return isControl && correct === YES;
  return decision === "wrong" && isControl && correct === NO;
}

async function answersView(route) {
  const [info, found] = await Promise.all([study(), world()]);
  const filter = route.parameters;
  const began = performance.now();
  const rows = fittingRows(found, filter);
  const words = (filter.q || "").trim();
  const status = h("p", { class: "status", role: "status", "data-filter-ms": (performance.now() - began).toFixed(1) });
  const list = h("div", { class: "answers" });
  if (words) searchTexts(route, found, rows, words, status, list);
  else {
    status.textContent = `${count(rows.length)} of ${counted(found.decisions.length, "answer")}`;
    showAnswers(route, found, rows, [], list);
  }
  return {
    title: "Answers",
    body: [
      h(
        "div",
        { class: "filters" },
        h(
          "form",
          {
            class: "choice search",
            role: "search",
            onsubmit: (event) => {
              event.preventDefault();
              route.change({ q: event.target.elements.q.value });
            },
          },
          h("label", { for: "choice-q" }, "Text"),
          h("input", {
            id: "choice-q",
            name: "q",
            type: "search",
            value: words,
            placeholder: 'words of an answer, its reasoning or a rationale; "in quotes" together',
          }),
          h("button", { type: "submit" }, "Search"),
        ),
        choice(route, "model", "Model", same(modelsOf(info))),
        choice(route, "regime", "Regime", same(info.regimes)),
        runsOf(info).length > 1 ? choice(route, "run", "Run", same(runsOf(info))) : null,
        choice(route, "dataset", "Dataset", datasetOptions(info)),
        choice(route, "family", "Family", same(found.families)),
        choice(route, "side", "Side", [
          ["control", "control"],
          ["void", "void"],
        ]),
        choice(
          route,
          "outcome",
          "Pair",
          OUTCOMES.map(({ id, title }) => [id, title.toLowerCase()]),
        ),
        choice(route, "decision", "Answer", DECISIONS),
        toggle(route, "split", "judges disagree"),
        filter.scenario
          ? h(
              "span",
              { class: "choice" },
              h("span", null, "Scenario"),
              link(["answers"], { ...filter, scenario: "" }, `${filter.scenario} ✕`),
            )
          : null,
      ),
      section(null, status, list),
    ],
  };
}

// Show rows in pages. terms: words to mark.
function showAnswers(route, found, rows, terms, list) {
  const pages = Math.max(1, Math.ceil(rows.length / PAGE_ROWS));
  const page = Math.min(pages, Math.max(1, Number(route.parameters.page) || 1));
  const shown = rows.slice((page - 1) * PAGE_ROWS, page * PAGE_ROWS);
  TOUR.rows = rows;
  list.replaceChildren(...shown.map((row) => answerLine(found, row, terms)));
  if (!rows.length) list.append(notice(nothingFits(route.parameters)));
  add(list, [pageLinks(route, page, pages)]);
}

function nothingFits({ q, page, ...filters }) {
  if (q) return "No answer holds all these words. Leave some out; words in quotes must stand together.";
  return Object.values(filters).some(Boolean) ? "No answer fits. Widen the filters above." : "This study has no answers yet.";
}

// One answer in a list; its text arrives when its shard is read.
function answerLine(found, row, terms) {
  const { info, items, pairs, pairOf, decisions } = found;
  const [item, evaluation] = [decisions.item[row], decisions.evaluation[row]];
  const pair = pairs[pairOf[item]];
  const [decision, kind] = decisionWords(info, items, decisions, row);
  const text = h("div", { class: "excerpt" }, "…");
  afterPaint(() =>
    answer(row).then(
      (read) => text.replaceChildren(excerpt(read, terms)),
      (error) => text.replaceChildren(notice(error.message, "error")),
    ),
  );
  return h(
    "article",
    { class: "answer" },
    h(
      "div",
      { class: "about" },
      pairLink(pair, evaluation, info, {}, pair.scenario),
      h("span", { class: "tag" }, items.side[item]),
      chip(decision, kind),
      h("span", { class: "soft" }, `${evaluationName(info, evaluation)} · ${titleOf(info, pair.dataset)}`),
    ),
    h("p", { class: "asked" }, untrusted(items.question[decisions.item[row]])),
    text,
  );
}

// The beginning of an answer, or the place of its text, reasoning or votes where the words stand.
function excerpt(read, terms) {
  const places = [
    read.fragment ? ["it began: ", read.fragment] : ["", read.text],
    ["reasoning: ", read.reasoning],
    ...read.votes.map((vote) => [`${vote.judge}: `, vote.rationale]),
  ];
  const { label, text, at: first } = bestPlace(places, terms);
  if (text === null || text === undefined)
    return h("span", { class: "absent" }, read.error ? `no text (${read.error})` : "no text");
  const at = Math.max(0, first - 120);
  return h(
    "span",
    null,
    label ? h("span", { class: "soft" }, label) : null,
    at ? "… " : null,
    untrusted(text.slice(at, at + 320), { terms }),
    at + 320 < text.length ? " …" : null,
  );
}

// Look for words in the texts of these rows, shard by shard; the list grows as they are found.
async function searchTexts(route, found, rows, words, status, list) {
  const { info } = found;
  const terms = searchTerms(words);
  const byShard = new Map();
  for (const row of rows) {
    const number = shardOf(info, row);
    if (!byShard.has(number)) byShard.set(number, []);
    byShard.get(number).push(row);
  }
  const matches = [];
  const numbers = [...byShard.keys()].sort((a, b) => a - b);
  let told = 0;
  try {
    for (const [done, number] of numbers.entries()) {
      const read = await shard(number);
      if (!route.isCurrent()) return;
      const before = matches.length;
      for (const row of byShard.get(number)) if (mentions(read, row - read.first, terms)) matches.push(row);
      if (before < PAGE_ROWS && matches.length > before) showAnswers(route, found, matches, terms, list);
      if (performance.now() - told > 100) {
        told = performance.now();
        status.textContent = `${count(matches.length)} found so far; ${Math.round((100 * (done + 1)) / numbers.length)} % of the texts read`;
        await new Promise((next) => setTimeout(next)); // let the page answer
      }
    }
    status.textContent = `“${words}”: ${count(matches.length)} of ${counted(rows.length, "answer")}`;
    showAnswers(route, found, matches, terms, list);
  } catch (error) {
    status.replaceChildren(notice(error.message, "error"));
  }
}

function mentions({ texts, votes }, at, terms) {
  const own = [texts.text[at], texts.fragment[at], texts.reasoning[at]];
  for (let k = lowerBound(votes.answer, at); k < votes.length && votes.answer[k] === at; k++) own.push(votes.rationale[k]);
  return holdsAll(own, terms);
}

function chip(text, kind) {
  return h("span", { class: `chip ${kind}` }, text);
}

// The pairs of the last list, for the pair page's previous and next.
const TOUR = { rows: [] };

function pairLink(pair, evaluation, info, more, text, attributes) {
  const [model, regime, run] = info.evaluations[evaluation] || [];
  return link(["pair", pair.dataset, pair.scenario], { model, regime, run, ...more }, text, attributes);
}
