/** The page: a list of jobs and the job that the address names, or the dome; a form for a token where the server asks for one. */

import { getSession, signOut, Unauthenticated } from "./api";
import { DomeView } from "./domeView";
import { element, find } from "./element";
import { JobList } from "./jobList";
import { JobView } from "./jobView";
import { SignIn } from "./signIn";
import { WorkerList } from "./workerList";

const REFRESH_MS = 3000;
const DOME = "#/dome";

const main = find("main");
const jobs = find("jobs");
const account = find("account");
const connection = find("connection");
const domeLink = find<HTMLAnchorElement>("dome");
const list = new JobList(jobs);
const workers = find("workers");
const workerList = new WorkerList(workers);
let view: JobView | DomeView | null = null;
let isSignedOut = false;

function showConnection(open: boolean): void {
  connection.textContent = open || isSignedOut ? "" : "Connection lost; trying again.";
}

async function refreshList(): Promise<void> {
  try {
    const newest = await list.refresh();
    showConnection(true);
    if (!location.hash && newest) location.replace(`#/${newest}`);
  } catch (problem) {
    if (problem instanceof Unauthenticated) askForToken();
    showConnection(false);
  }
}

async function open(): Promise<void> {
  if (!location.hash || isSignedOut) return;
  view?.stop();
  view = null;
  const id = location.hash.match(/^#\/(\w+)$/)?.[1] ?? "";
  const isDome = location.hash === DOME;
  list.select(id);
  if (isDome) domeLink.setAttribute("aria-current", "page");
  else domeLink.removeAttribute("aria-current");
  if (!id) {
    showProblem(`No job has the address ${location.hash}; choose one from the list.`);
    return;
  }
  view = isDome ? new DomeView(showConnection) : new JobView(id, () => void refreshList(), showConnection);
  main.replaceChildren(view.root);
  try {
    await view.start();
  } catch (problem) {
    if (problem instanceof Unauthenticated) askForToken();
    else showProblem(problem instanceof Error ? problem.message : String(problem));
  }
}

function showProblem(sentence: string): void {
  main.replaceChildren(element("p", { class: "failure", role: "alert" }, sentence));
}

function askForToken(): void {
  if (isSignedOut) return;
  isSignedOut = true;
  view?.stop();
  view = null;
  jobs.hidden = true;
  domeLink.hidden = true;
  workers.hidden = true;
  account.replaceChildren();
  const form = new SignIn(() => void start());
  main.replaceChildren(form.root);
  form.root.querySelector("input")?.focus();
}

async function showAccount(): Promise<void> {
  const session = await getSession();
  domeLink.hidden = !session.is_open && !["admin", "operate-dome"].some((scope) => session.scopes.includes(scope));
  if (session.is_open) return;
  const button = element("button", { type: "button" }, "Sign out");
  button.addEventListener("click", () => void signOut().finally(() => location.reload()));
  account.replaceChildren(`${session.name} `, button);
}

async function start(): Promise<void> {
  isSignedOut = false;
  jobs.hidden = false;
  workers.hidden = false;
  main.replaceChildren();
  await refreshList();
  if (isSignedOut) return;
  void showAccount();
  void workerList.refresh();
  await open();
}

window.addEventListener("hashchange", () => void open());
window.addEventListener("unhandledrejection", (event) => {
  if (!(event.reason instanceof Unauthenticated)) return;
  event.preventDefault();
  askForToken();
});
setInterval(() => {
  if (document.hidden || isSignedOut) return;
  void refreshList();
  void workerList.refresh();
}, REFRESH_MS);
void start();
