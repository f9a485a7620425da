// The review of one scenario: its clips, a key for each decision, and what a correction would cost.

const FIELDS = ["question", "ill_posed_question", "labels", "answer", "params"];
const said = field("said");
let wanted = ""; // the decision that waits for a reason

const clips = SHOWN.clips.map((side) => {
  const path = `/clip/${encodeURIComponent(SHOWN.scenario_id)}/${side}`;
  const [title, note] = SHOWN.captions[side].split(/: (.*)/s);
  return { title, note, path, kind: side };
});
const shownPlayer = player(clips, SHOWN.fps, true);
field("clips").append(shownPlayer.element);

// --- what a correction changes ----------------------------------------------------------------------------------------

const original = {
  question: SHOWN.words.question,
  ill_posed_question: SHOWN.words.ill_posed_question,
  labels: SHOWN.words.labels.join(", "),
  answer: SHOWN.words.answer,
  params: JSON.stringify(SHOWN.params, null, 1),
};
for (const name of FIELDS) field(name).value = original[name];

// The fields that differ from the record, as the corrections have them. Throws SyntaxError for parameters that are no
// JSON object.
function changes() {
  const found = {};
  for (const name of FIELDS) {
    const value = field(name).value.trim();
    if (value === original[name].trim()) continue;
    if (name === "labels")
      found.labels = value
        .split(",")
        .map((label) => label.trim())
        .filter(Boolean);
    else if (name === "params") found.params = changedParams(value);
    else found[name] = value;
  }
  return found;
}

function changedParams(text) {
  const given = JSON.parse(text);
  const differs = ([name, value]) => JSON.stringify(value) !== JSON.stringify(SHOWN.params[name]);
  return Object.fromEntries(Object.entries(given).filter(differs));
}

const send = (path, body) => post(path, { scenario_id: SHOWN.scenario_id, ...body });

let asked = 0;
async function preview() {
  const own = ++asked;
  await new Promise((next) => setTimeout(next, 250)); // until the reviewer pauses
  if (own !== asked) return;
  let text;
  try {
    const found = changes();
    if (Object.keys(found).length) {
      const read = await send("/preview", { changes: found });
      text = `Question: ${read.question}\n${read.cost}.`;
    } else text = "Nothing is changed yet.";
  } catch (error) {
    text = error.message;
  }
  if (own === asked) field("preview").textContent = visible(text);
}
for (const name of FIELDS) field(name).addEventListener("input", preview);

// --- decisions --------------------------------------------------------------------------------------------------------

field("why").value = sessionStorage.getItem("why") || "";

function leave(to) {
  location.href = to ? `/scenario/${encodeURIComponent(to)}?queue=${SHOWN.queue}` : `/?queue=${SHOWN.queue}`;
}

async function decide(action) {
  const why = field("why").value.trim();
  if (!why) {
    wanted = action;
    said.textContent = `To ${action} needs a reason: press w, write it, then press Enter.`;
    said.classList.add("error");
    return;
  }
  sessionStorage.setItem("why", why);
  wanted = "";
  try {
    if (action === "undo") {
      await send("/undo", { why, seen: SHOWN.seen });
      location.reload();
      return;
    }
    const found = action === "correct" || action === "add" ? changes() : {};
    if ((action === "correct" || action === "add") && !Object.keys(found).length) {
      field("changes").open = true;
      field("question").focus();
      said.textContent = "Change something first: question, labels, answer or parameters.";
      return;
    }
    await send("/decide", { action, changes: found, why, seen: SHOWN.seen });
    if (action === "add")
      said.textContent = "Added. A run makes it in every study that holds all scenarios, or names it.";
    else leave(SHOWN.after);
  } catch (error) {
    said.textContent = visible(error.message);
    said.classList.add("error");
  }
}

function open_changes() {
  field("changes").open = true;
  field("question").focus();
}

const KEYS = {
  ...shownPlayer.keys,
  k: () => decide("keep"),
  c: () => decide("correct"),
  d: () => decide("discard"),
  a: () => decide("add"),
  u: () => !field("undo").disabled && decide("undo"),
  n: () => SHOWN.after && leave(SHOWN.after),
  p: () => SHOWN.before && leave(SHOWN.before),
  e: open_changes,
  w: () => field("why").focus(),
};
for (const name of ["keep", "correct", "discard", "add", "undo"])
  field(name).addEventListener("click", () => decide(name));
field("before").addEventListener("click", KEYS.p);
field("after").addEventListener("click", KEYS.n);
listen(KEYS, (event) => event.key === "Enter" && event.target.id === "why" && decide(wanted || "keep"));
