// All scenes: control, void and twin side by side, for somebody who wants to see what is asked.

const SCENES_SHOWN = 12;

async function scenesView(route) {
  const [info, found, about] = await Promise.all([study(), world(), scenarios()]);
  const { family = "" } = route.parameters;
  const seen = new Set();
  const scenes = found.pairs.filter((pair) => {
    const fits = pair.control >= 0 && (!family || pair.family === family) && !seen.has(pair.scenario);
    if (fits) seen.add(pair.scenario);
    return fits;
  });
  const pages = Math.max(1, Math.ceil(scenes.length / SCENES_SHOWN));
  const page = Math.min(pages, Math.max(1, Number(route.parameters.page) || 1));
  return {
    title: "Scenes",
    body: [
      h(
        "p",
        { class: "lead" },
        "Each scene's control, its void, and a twin: another world behind the same void; of two events all four clips.",
      ),
      h("div", { class: "filters" }, choice(route, "family", "Family", same(found.families))),
      scenes.length ? null : notice(`${NOT_RUN}: this study has no such scenes`),
      scenes.slice((page - 1) * SCENES_SHOWN, page * SCENES_SHOWN).map((pair) => sceneCard(info, found, about, pair)),
      pageLinks(route, page, pages),
    ],
  };
}

function sceneCard(info, { items }, about, pair) {
  const scene = about.get(pair.scenario) || { certificate: [] };
  const all = scene.clips?.map(({ name, path }) => ["lane-clip", clipName(name), path]) || [
    ["control", `Control: ${items.control_answer[pair.control] ?? ""}`, items.clip[pair.control]],
    ["void", `Void: ${scene.intervention ?? ""}`, pair.void < 0 ? null : items.clip[pair.void]],
    ["twin", `Twin, same void: ${scene.twin_answer ?? ""}`, scene.twin_clip],
  ];
  const clips = all.filter(([, , path]) => path);
  const isWide = Boolean(scene.clips);
  return section(
    null,
    h("h2", null, link(["pair", pair.dataset, pair.scenario], {}, pair.scenario)),
    h("p", null, untrusted(items.question[pair.control])),
    h(
      "div",
      { class: isWide ? "clips of-4" : "clips of-3" },
      clips.map(([kind, caption, path]) =>
        h(
          "figure",
          { class: `clip ${kind}` },
          h("video", {
            src: `${clipAddress(path)}#t=${((kind === "control" || isWide) && scene.shown_at) || 1000}`,
            muted: true,
            controls: true,
            playsinline: true,
            preload: "metadata",
            "aria-label": caption,
          }),
          h("figcaption", null, h("b", null, caption)),
        ),
      ),
    ),
    scene.certificate?.length ? h("p", { class: "note" }, scene.certificate.join(" · ")) : null,
  );
}
