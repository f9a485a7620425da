// Clips that play in step: one clock, one frame at a time.

const HELD = []; // addresses of clips in memory, until the next player takes their place

// The address of a clip. From a web host it is read whole, since some hosts send no part of a file, and a browser can
// then not step through it; a page on `file:` may not read it, and need not.
async function addressOf(path) {
  if (!location.protocol.startsWith("http")) return path;
  try {
    const answer = await fetch(path);
    if (!answer.ok) return path;
    HELD.push(URL.createObjectURL(await answer.blob()));
    return HELD.at(-1);
  } catch {
    return path; // the element says that it cannot be played
  }
}

// The address of a clip that the tables name.
function clipAddress(path) {
  return `${document.documentElement.dataset.clips || ""}${path}`;
}

let speed = 1; // stays for the next pair

// clips: [{title, path, note, kind, below}]; path is null where the folder has no such clip; below: {element, show},
// which is told of each frame. fps: frames a second.
function player(clips, fps, hasClips) {
  const videos = [];
  for (const held of HELD.splice(0)) URL.revokeObjectURL(held);
  const figures = clips.map(({ title, path, note, kind, below }) => {
    const video = path
      ? h("video", { muted: true, playsinline: true, preload: "auto", "aria-label": title, tabindex: "-1" })
      : null;
    const absent = hasClips
      ? "This clip is not in the folder."
      : "The clips were left out of this folder; `traps site` without --without-clips puts them in.";
    if (video) {
      videos.push(video);
      addressOf(clipAddress(path)).then((found) => video.setAttribute("src", found));
    }
    return h(
      "figure",
      { class: `clip ${kind}` },
      video || h("div", { class: "clip-absent" }, absent),
      h("figcaption", null, h("b", null, title), note ? ` ${note}` : null),
      below ? below.element : null,
    );
  });
  const element = h("div", { class: "player" }, h("div", { class: `clips of-${clips.length}` }, figures));
  if (!videos.length) return { element, keys: {} };

  const step = 1 / (fps || 25);
  let playing = false;
  let frames = 1;
  const button = h("button", { type: "button", onclick: () => (playing ? pause() : play()) }, "Play");
  const slider = h("input", {
    type: "range",
    min: 0,
    max: 0,
    step: 1,
    value: 0,
    "aria-label": "frame",
    oninput: () => {
      pause();
      show(Number(slider.value));
    },
  });
  const place = h("output", { class: "place" });
  const last = (video) => Math.max(0, Math.round((video.duration || 0) / step) - 1);
  const tell = (frame) => {
    slider.value = frame;
    for (const { below } of clips) if (below) below.show(frame);
    const ended = videos
      .filter((video) => frame > last(video))
      .map((video) => video.getAttribute("aria-label").split(":")[0].toLowerCase());
    place.textContent = `frame ${frame + 1} of ${frames}, ${(frame * step).toFixed(2)} s${ended.length ? `; ${ended.join(" and ")} ended` : ""}`;
  };
  // Half a frame in, so that rounding shows this frame and not the one before.
  const show = (frame) => {
    for (const video of videos) video.currentTime = (Math.min(frame, last(video)) + 0.5) * step;
    tell(frame);
  };
  const longest = () => videos.reduce((best, video) => (last(video) > last(best) ? video : best));
  const pause = () => {
    playing = false;
    button.textContent = "Play";
    for (const video of videos) video.pause();
  };
  const follow = () => {
    if (!playing || !element.isConnected) return pause();
    const leader = longest();
    tell(Math.min(frames - 1, Math.floor(leader.currentTime / step)));
    for (const video of videos) {
      if (
        video !== leader &&
        !video.ended &&
        Math.abs(video.currentTime - leader.currentTime) > 2 * step &&
        leader.currentTime < video.duration
      )
        video.currentTime = leader.currentTime;
    }
    if (leader.ended) return pause();
    return requestAnimationFrame(follow);
  };
  const play = () => {
    if (Number(slider.value) >= frames - 1) show(0);
    playing = true;
    button.textContent = "Pause";
    const now = Number(slider.value);
    for (const video of videos) video.playbackRate = speed;
    for (const video of videos) if (now < last(video)) video.play().catch(pause);
    requestAnimationFrame(follow);
  };
  const move = (by) => {
    pause();
    show(Math.min(frames - 1, Math.max(0, Number(slider.value) + by)));
  };
  const speeds = h(
    "select",
    {
      "aria-label": "speed",
      onchange: () => {
        speed = Number(speeds.value);
        for (const video of videos) video.playbackRate = speed;
      },
    },
    [0.25, 0.5, 1, 2].map((value) => h("option", { value, selected: value === speed }, `${value}×`)),
  );
  for (const video of videos) {
    video.addEventListener("loadedmetadata", () => {
      frames = last(longest()) + 1;
      slider.max = frames - 1;
      tell(Number(slider.value));
    });
    video.addEventListener("error", () =>
      video.replaceWith(h("div", { class: "clip-absent" }, "This clip cannot be played here.")),
    );
  }
  element.append(
    h(
      "div",
      { class: "controls" },
      button,
      h("button", { type: "button", "aria-label": "one frame back", onclick: () => move(-1) }, "◂"),
      h("button", { type: "button", "aria-label": "one frame on", onclick: () => move(1) }, "▸"),
      slider,
      speeds,
      place,
    ),
  );
  return {
    element,
    keys: { " ": () => (playing ? pause() : play()), ArrowLeft: () => move(-1), ArrowRight: () => move(1) },
  };
}
