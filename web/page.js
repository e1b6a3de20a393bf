// The page: projects, scans, jobs, picture and downloads, all through the public API.

const $ = (id) => document.getElementById(id);
const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
let shownVersion = null;

// The key stays in this tab, goes into a header, and never into an address: addresses are logged and shared.
const key = () => sessionStorage.getItem("key");

function showKeyForm(needed) {
  $("key-form").hidden = !needed;
  $("forget-key").hidden = needed || !key();
  $("layout").hidden = needed;
}

/** What a refusal or failure says: what it is, why, and when to try again where it says that. */
class Refusal extends Error {
  constructor(response, problem) {
    const seconds = Number.parseInt(response.headers.get("retry-after"), 10);
    const what = problem?.title || response.statusText || `status ${response.status}`;
    const why = problem?.detail ? `: ${problem.detail}` : "";
    super(`${what}${why}${seconds > 0 ? ` (try again in ${inWords(seconds)})` : ""}`);
    this.retryMs = seconds > 0 ? seconds * 1000 : 0;
  }
}

function inWords(seconds) {
  if (seconds < 100) return `${seconds} s`;
  return seconds < 6000 ? `${Math.ceil(seconds / 60)} min` : `${Math.ceil(seconds / 3600)} h`;
}

/** An answer of the API, or an error that says what its problem says. */
async function request(path, options) {
  const headers = new Headers(options?.headers);
  if (key()) headers.set("authorization", `Bearer ${key()}`);
  const response = await fetch(path, { ...options, headers });
  showKeyForm(response.status === 401);
  if (response.ok) return response;
  const problem = await response.json().catch(() => null);
  throw new Refusal(response, problem);
}

async function api(path, options) {
  const response = await request(path, options);
  return response.status === 204 ? null : response.json();
}

/** A link to something to download. With a key, which a link cannot carry, it is fetched: to a file where the browser can. */
function download(text, path, name) {
  const link = element("a", { href: path }, text);
  const fetched = async () => {
    const file = await window.showSaveFilePicker?.({ suggestedName: name }).then((handle) => handle.createWritable());
    const response = await request(path);
    if (file) return response.body.pipeTo(file);
    const address = URL.createObjectURL(await response.blob());
    element("a", { href: address, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(address), 60_000);
  };
  link.addEventListener("click", (event) => {
    if (!key()) return;
    event.preventDefault();
    fetched().catch((error) => { $("notice").textContent = error.name === "AbortError" ? "" : error.message; });
  });
  return link;
}

/** Shows a picture. */
async function showPicture(path) {
  const picture = $("preview");
  const address = key() ? URL.createObjectURL(await (await request(path)).blob()) : path;
  picture.onload = () => { picture.hidden = false; URL.revokeObjectURL(address); };
  picture.onerror = () => { picture.hidden = true; URL.revokeObjectURL(address); };
  picture.src = address;
}

/** All items of a list. */
async function all(path) {
  const items = [];
  let cursor = "";
  do {
    const part = await api(`${path}?limit=200${cursor}`);
    items.push(...part.items);
    cursor = part.next ? `&cursor=${part.next}` : "";
  } while (cursor);
  return items;
}

/** An element with text or children; text is never read as markup. */
function element(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes ?? {})) made.setAttribute(name, value);
  made.append(...children.filter((c) => c !== null && c !== undefined));
  return made;
}

const state = (word) => element("span", { class: `state ${word}` }, word);
const chosen = () => location.hash.slice(1);
const bytes = (n) => (n < 1e6 ? `${(n / 1e3).toFixed(0)} kB` : `${(n / 1e6).toFixed(1)} MB`);

function scanRow(scan) {
  const out = scan.outcome;
  let where = "";
  if (out?.status === "registered") where = `component ${out.component}, ${out.landmarks} landmarks, ${out.neighbours} neighbours`;
  if (out?.status === "waiting") where = because(out);
  if (out?.status === "failed") where = out.problem.detail;
  const path = `/v1/projects/${scan.project}/scans/${scan.id}`;
  return element("tr", {},
    element("td", {}, download(scan.name, `${path}/original`, scan.name)),
    element("td", { class: "fix" }, state(scan.state)),
    element("td", { class: "soft" }, where),
    element("td", { class: "fix soft" }, scan.points ? `${scan.points.toLocaleString("en")} points` : bytes(scan.bytes)));
}

/** A reason in words. */
function because(why) {
  const n = (x) => x.toFixed(1);
  const words = {
    ambiguous: () => `ambiguous: support ${n(why.best_support)}, of another pose ${n(why.rival_support)}`,
    contradicted: () => `contradicted: ${why.against} pairs are sure of another pose, ${why.agreeing} were of this one`,
    "violates-free-space": () => `violates free space: ${n(100 * why.violation)} %, allowed ${n(100 * why.allowed)} %`,
    indistinct: () => `one pair shares little but three planes: ${n(100 * why.beyond_planes)} % beyond them, needed ${n(100 * why.needed)} %`,
    "single-pair": () => `two pieces share one pair alone: support ${n(why.best_support)}`,
    forbidden: () => "forbidden by a decision",
    "too-little-support": () => `too little support: ${n(why.best_support)}, needed ${n(why.needed)}`,
  };
  return words[why.reason]?.() ?? why.reason.replaceAll("-", " ");
}

function button(text, action) {
  const made = element("button", {}, text);
  made.addEventListener("click", () => act(action));
  return made;
}

const post = (path, body) => api(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) });

/** An open join with its poses, each of which may be chosen, and the choice of none. */
function openJoinRow(open, own, version) {
  const decide = (verdict, more) => () =>
    post(`${own}/decisions`, { verdict, scan_a: open.scan_a.id, scan_b: open.scan_b.id, ...more });
  const piece = (scan, scans) => scans > 1 ? `${scan.name} (with ${scans - 1} more)` : scan.name;
  const poses = open.poses.map((pose, index) => element("p", {},
    element("span", { class: "soft" }, `support ${pose.support.toFixed(1)} by ${pose.edges} ${pose.edges === 1 ? "edge" : "edges"}, ${pose.inliers.toLocaleString("en")} inliers, ` +
      `${(100 * pose.violation).toFixed(1)} % in free space`),
    button("Join so", decide("join", { pose: index, version }))));
  return element("tr", {},
    element("td", {}, `${piece(open.scan_a, open.scans_a)} – ${piece(open.scan_b, open.scans_b)}`,
      element("div", { class: "soft" }, because(open.refusal))),
    element("td", {}, ...poses),
    element("td", { class: "fix" }, button("Keep apart", decide("forbid", {}))));
}

function decisionRow(decision, own, names) {
  const name = (id) => names.get(id) ?? id;
  const what = { join: "belong together", forbid: decision.a_from_b ? "do not belong together at one pose" : "do not belong together" };
  return element("tr", {},
    element("td", {}, `${name(decision.scan_a)} and ${name(decision.scan_b)} ${what[decision.verdict]}`),
    element("td", { class: "fix" }, button("Take back", () => api(`${own}/decisions/${decision.id}`, { method: "DELETE" }))));
}

function jobRow(job, names) {
  const open = job.status === "running" || job.status === "accepted";
  let what = job.outcome ? `${job.outcome.status}, version ${job.outcome.version}` : job.problem?.detail ?? "";
  if (open) what = job.stage ?? "queued";
  const bar = open ? element("progress", { max: 100, value: job.progress }) : null;
  const dismiss = open && !["removal", "decision"].includes(job.kind) ? element("button", {}, "Dismiss") : null;
  dismiss?.addEventListener("click", () => act(() => api(`/v1/jobs/${job.id}`, { method: "DELETE" })));
  return element("tr", {},
    element("td", {}, job.kind.replaceAll("-", " "), " ", element("span", { class: "soft" }, names.get(job.scan) ?? "")),
    element("td", { class: "fix" }, state(job.status)),
    element("td", { class: "soft" }, bar, " ", what),
    element("td", { class: "fix" }, dismiss));
}

async function showProjects() {
  const projects = await all("/v1/projects");
  if (!chosen() && projects.length) location.hash = projects.at(-1).id;
  $("projects").replaceChildren(...projects.map((p) => {
    const link = element("a", { href: `#${p.id}` }, p.name);
    if (p.id === chosen()) link.setAttribute("aria-current", "page");
    return element("li", {}, link);
  }));
  return projects.find((p) => p.id === chosen());
}

async function showProject(project) {
  $("main").hidden = !project;
  $("nothing").hidden = Boolean(project);
  if (!project) return;
  const own = `/v1/projects/${project.id}`;
  const [scans, jobs, decisions] = await Promise.all(["scans", "jobs", "decisions"].map((list) => all(`${own}/${list}`)));
  const names = new Map(scans.map((s) => [s.id, s.name]));
  const count = (word) => scans.filter((s) => s.state === word).length;
  $("name").textContent = project.name;
  $("summary").textContent =
    `version ${project.version}: ${count("registered")} of ${scans.length} scans registered, ${count("waiting")} waiting`;
  const open = jobs.filter((j) => !j.finished);
  const ended = jobs.filter((j) => j.finished).reverse().slice(0, Math.max(4, 12 - open.length));
  $("jobs").replaceChildren(...[...open, ...ended].map((j) => jobRow(j, names)));
  $("scans").replaceChildren(...scans.map(scanRow));
  $("decided").hidden = decisions.length === 0;
  $("decisions").replaceChildren(...decisions.map((d) => decisionRow(d, own, names)));
  await showVersion(project, own);
}

async function showVersion(project, own) {
  const version = `${project.id}/${project.version}`;
  if (version === shownVersion) return;
  const some = project.version > 0;
  const model = await api(some ? `${own}/versions/${project.version}` : `${own}/model`);
  if (project.id !== chosen()) return;
  shownVersion = version;
  $("open").hidden = model.open_joins.length === 0;
  $("open-joins").replaceChildren(...model.open_joins.map((open) => openJoinRow(open, own, model.version)));
  const at = `version=${project.version}`;
  const links = [["merged cloud", `cloud?${at}`, "merged.ply"], ["poses (json)", `poses?${at}`, "poses.json"],
    ["poses (TUM)", `poses?format=tum&${at}`, "poses.tum"], ["poses (3DMatch log)", `poses?format=3dmatch-log&${at}`, "poses.log"],
    ["graph", `graph?${at}`, "graph.json"], ["model", `versions/${project.version}`, "model.json"]];
  $("downloads").replaceChildren(...(some ? links.map(([text, path, name]) => download(text, `${own}/${path}`, name)) : []));
  if (some) await showPicture(`${own}/preview?${at}`).catch(() => { $("preview").hidden = true; });
  else $("preview").hidden = true;
}

async function refresh() {
  await showProject(await showProjects());
}

async function act(action) {
  try {
    await action();
    $("notice").textContent = "";
    await refresh();
  } catch (error) {
    $("notice").textContent = error.message;
  }
}

async function upload(files) {
  const own = `/v1/projects/${chosen()}/scans`;
  for (const file of files) {
    $("notice").textContent = `uploading ${file.name}`;
    const sent = api(`${own}?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
    await sent.catch((error) => { throw new Error(`${file.name} was not taken. ${error.message}`); });
  }
}

$("new-project").addEventListener("submit", (event) => {
  event.preventDefault();
  act(async () => {
    const made = await post("/v1/projects", { name: $("new-name").value });
    $("new-name").value = "";
    location.hash = made.id;
  });
});
$("key-form").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("key", $("key").value.trim());
  $("key").value = "";
  $("key-refused").hidden = true;
  shownVersion = null;
  refresh().catch(() => { $("key-refused").hidden = $("key-form").hidden; });
});
$("forget-key").addEventListener("click", () => {
  sessionStorage.removeItem("key");
  location.reload();
});
$("files").addEventListener("change", (event) => act(() => upload([...event.target.files])));
for (const asked of document.querySelectorAll("[data-kind]")) {
  asked.addEventListener("click", () => act(() => post(`/v1/projects/${chosen()}/jobs`, { kind: asked.dataset.kind })));
}
addEventListener("hashchange", () => refresh().catch(() => {}));

for (;;) {
  // What is wrong goes away when a look succeeds: the service may be restarting, or have too much to do.
  const wrong = $("key-form").hidden ? await refresh().then(() => null, (error) => error) : null;
  $("trouble").textContent = wrong?.message ?? "";
  await sleep(Math.max(document.hidden ? 10_000 : 1_500, wrong?.retryMs ?? 0));
}
