// The page: projects, scans, jobs, picture and downloads, all through the public API.

const $ = (id) => document.getElementById(id);
const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
let shownVersion = null;

async function api(path, options) {
  const response = await fetch(path, options);
  const body = response.status === 204 ? null : await response.json();
  if (!response.ok) throw new Error(body?.detail ?? response.statusText);
  return body;
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
  if (out?.status === "waiting") where = out.reason.replaceAll("-", " ");
  if (out?.status === "failed") where = out.problem.detail;
  const path = `/v1/projects/${scan.project}/scans/${scan.id}`;
  return element("tr", {},
    element("td", {}, element("a", { href: `${path}/original` }, scan.name)),
    element("td", { class: "fix" }, state(scan.state)),
    element("td", { class: "soft" }, where),
    element("td", { class: "fix soft" }, scan.points ? `${scan.points.toLocaleString("en")} points` : bytes(scan.bytes)));
}

function jobRow(job, names) {
  const open = job.status === "running" || job.status === "accepted";
  let what = job.outcome ? `${job.outcome.status}, version ${job.outcome.version}` : job.problem?.detail ?? "";
  if (open) what = job.stage ?? "queued";
  const bar = open ? element("progress", { max: 100, value: job.progress }) : null;
  const dismiss = open && job.kind !== "removal" ? element("button", {}, "Dismiss") : null;
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
  const [scans, jobs] = await Promise.all([all(`${own}/scans`), all(`${own}/jobs`)]);
  const names = new Map(scans.map((s) => [s.id, s.name]));
  const count = (word) => scans.filter((s) => s.state === word).length;
  $("name").textContent = project.name;
  $("summary").textContent =
    `version ${project.version}: ${count("registered")} of ${scans.length} scans registered, ${count("waiting")} waiting`;
  const open = jobs.filter((j) => !j.finished);
  const ended = jobs.filter((j) => j.finished).reverse().slice(0, Math.max(4, 12 - open.length));
  $("jobs").replaceChildren(...[...open, ...ended].map((j) => jobRow(j, names)));
  $("scans").replaceChildren(...scans.map(scanRow));
  showVersion(project, own);
}

function showVersion(project, own) {
  const version = `${project.id}/${project.version}`;
  if (version === shownVersion) return;
  shownVersion = version;
  const at = `version=${project.version}`;
  const links = [["merged cloud", `cloud?${at}`], ["poses (json)", `poses?${at}`], ["poses (TUM)", `poses?format=tum&${at}`],
    ["poses (3DMatch log)", `poses?format=3dmatch-log&${at}`], ["graph", `graph?${at}`], ["model", `versions/${project.version}`]];
  const some = project.version > 0;
  $("downloads").replaceChildren(...(some ? links.map(([text, path]) => element("a", { href: `${own}/${path}` }, text)) : []));
  const picture = $("preview");
  picture.onload = () => { picture.hidden = false; };
  picture.onerror = () => { picture.hidden = true; };
  if (some) picture.src = `${own}/preview?${at}`;
  else picture.hidden = true;
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
    await api(`${own}?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
  }
}

$("new-project").addEventListener("submit", (event) => {
  event.preventDefault();
  act(async () => {
    const body = JSON.stringify({ name: $("new-name").value });
    const made = await api("/v1/projects", { method: "POST", headers: { "content-type": "application/json" }, body });
    $("new-name").value = "";
    location.hash = made.id;
  });
});
$("files").addEventListener("change", (event) => act(() => upload([...event.target.files])));
for (const button of document.querySelectorAll("[data-kind]")) {
  button.addEventListener("click", () => act(() => api(`/v1/projects/${chosen()}/jobs`, {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify({ kind: button.dataset.kind }),
  })));
}
addEventListener("hashchange", () => refresh().catch(() => {}));

for (;;) {
  // The service may be restarting; the next look will tell.
  await refresh().catch(() => {});
  await sleep(document.hidden ? 10_000 : 1_500);
}
