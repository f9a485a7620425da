// One thing to label: a clip or an answer, a key for each decision.

const material = field("material");
/** @type {Record<string, () => any>} */
let keys = {};

// --- what is shown ----------------------------------------------------------------------------------------------------

function part(title, text) {
  return [h("h2", null, title), untrusted(text, { tag: "div", class: "text" })];
}

if (SHOWN.task === "answerability") {
  const path = `/clip/${encodeURIComponent(SHOWN.handle)}`;
  const shownPlayer = player([{ title: "The clip", path, kind: "single" }], SHOWN.fps, true);
  add(material, [h("p", { class: "question" }, untrusted(SHOWN.question)), shownPlayer.element]);
  keys = { ...shownPlayer.keys };
  const video = material.querySelector("video");
  if (video) video.addEventListener("canplay", () => keys[" "](), { once: true });
} else {
  add(material, [h("p", { class: "question" }, untrusted(SHOWN.question))]);
  if (SHOWN.truth) add(material, [h("p", null, "True answer: ", h("b", null, untrusted(SHOWN.truth)))]);
  if (SHOWN.why) add(material, [h("p", null, "Why it could not be answered: ", SHOWN.why, ".")]);
  if (SHOWN.trace) add(material, part("What was thought", SHOWN.trace));
  add(material, part("What was answered", SHOWN.answer));
}

// --- decisions --------------------------------------------------------------------------------------------------------

let sending = false; // one label at a time, however fast the keys are
async function decide(label) {
  if (sending) return;
  sending = true;
  try {
    await post("/label", { handle: SHOWN.handle, label });
    location.replace(`/task/${SHOWN.task}`);
  } catch (error) {
    sending = false;
    field("said").textContent = visible(error.message);
    field("said").classList.add("error");
  }
}

async function back() {
  if (field("back").disabled || sending) return;
  try {
    await post("/reopen", { task: SHOWN.task });
    location.replace(`/task/${SHOWN.task}`);
  } catch (error) {
    field("said").textContent = visible(error.message);
    field("said").classList.add("error");
  }
}

function give() {
  if (SHOWN.task !== "answerability") {
    const boxes = [.../** @type {NodeListOf<HTMLInputElement>} */ (document.querySelectorAll(".axes input"))];
    return decide(Object.fromEntries(boxes.map((box) => [box.id, box.checked])));
  }
  const answer = field("answer").value.trim();
  if (answer) return decide({ answer });
  field("said").textContent = "Write an answer first, or say that it cannot be known.";
  return field("answer").focus();
}

for (const button of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("button[data-label]"))) {
  const act = () => decide(JSON.parse(button.dataset.label));
  button.addEventListener("click", act);
  keys[button.dataset.key] = act;
}
for (const box of /** @type {NodeListOf<HTMLInputElement>} */ (document.querySelectorAll(".axes input")))
  keys[box.dataset.key] = () => {
    box.checked = !box.checked;
  };
if (field("give")) field("give").addEventListener("click", give);
if (field("unknown")) {
  field("unknown").addEventListener("click", () => decide({ answer: null }));
  Object.assign(keys, { x: () => decide({ answer: null }), w: () => field("answer").focus() });
} else if (field("give")) keys.Enter = give;
keys.u = back;
field("back").addEventListener("click", back);
listen(keys, (event) => event.key === "Enter" && event.target.id === "answer" && (give() || true));
