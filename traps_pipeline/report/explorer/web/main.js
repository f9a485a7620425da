// Addresses and views.

const VIEWS = {
  "": leaderboardView,
  model: modelView,
  matrix: matrixView,
  answers: answersView,
  pair: pairView,
  compare: compareView,
  landscape: landscapeView,
  cases: casesView,
  scenes: scenesView,
};
let shownRoute = null;
let keysOfView = {};
let number = 0; // of the address that was shown last

function routeOf(hash) {
  const [path, query = ""] = hash.replace(/^#?\/?/, "").split(/\?(.*)/s);
  const [name = "", ...rest] = path.split("/").map(decoded);
  const own = ++number;
  const route = {
    name,
    path: rest,
    parameters: Object.fromEntries(new URLSearchParams(query)),
    isCurrent: () => own === number,
  };
  route.change = (changes) => {
    const path = [name, ...rest];
    location.hash = address(path, { ...route.parameters, page: "", ...changes }).slice(1);
  };
  return route;
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text; // an address that somebody mistyped
  }
}

async function show() {
  const began = performance.now();
  const route = routeOf(location.hash);
  const main = document.getElementById("main");
  const former = shownRoute;
  const isSame = former && former.name === route.name && former.path.join("/") === route.path.join("/");
  const waiting = setTimeout(() => main.setAttribute("aria-busy", "true"), 150);
  let view;
  try {
    const make = VIEWS[route.name];
    view = make ? await make(route) : missingView("No such page", `There is no page “${route.name}”.`);
  } catch (error) {
    view = { title: "This cannot be shown", body: [notice(error.message, "error")] };
  }
  clearTimeout(waiting);
  if (!route.isCurrent()) return;
  const focused = document.activeElement && main.contains(document.activeElement) ? document.activeElement.id : "";
  const heading = h("h1", { tabindex: "-1" }, view.heading || view.title);
  main.replaceChildren(...add(document.createDocumentFragment(), [heading, view.body]).childNodes);
  main.removeAttribute("aria-busy");
  shownRoute = route;
  keysOfView = view.keys || {};
  document.title = `${view.title} · ${document.documentElement.dataset.title}`;
  for (const each of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("#views a[data-view]"))) {
    if (each.dataset.view === route.name) each.setAttribute("aria-current", "page");
    else each.removeAttribute("aria-current");
  }
  const again = isSame && focused ? document.getElementById(focused) : null;
  if (again) again.focus({ preventScroll: true });
  else if (former && !isSame) {
    heading.focus({ preventScroll: true });
    scrollTo(0, 0);
  }
  document.documentElement.dataset.shown = `${location.hash} ${(performance.now() - began).toFixed(1)}`;
}

hearKeys(() => keysOfView);
document.getElementById("copy").addEventListener("click", (event) => copyAddress(event.target));
addEventListener("hashchange", show);
document.getElementById("skip").addEventListener("click", (event) => {
  event.preventDefault(); // its address would be taken for a view
  /** @type {HTMLElement} */ (document.querySelector("main h1"))?.focus();
});
// What every other view needs is read after the first one was painted, when the browser has nothing else to do.
const whenIdle = globalThis.requestIdleCallback || ((act) => setTimeout(act, 200));
show().then(() => afterPaint(() => whenIdle(() => world().catch(() => null), { timeout: 1000 })));
