/** The page: a list of jobs and the job that the address names, or the dome; a form for a token where the server asks for one. */

import { getSession, mayPass, type Session, sentenceOf, signOut, Unauthenticated } from "./api";
import { DomeView } from "./domeView";
import { element, find } from "./element";
import { JobList } from "./jobList";
import { JobView } from "./jobView";
import { SetupView } from "./setupView";
import { SignIn } from "./signIn";
import { WorkerList } from "./workerList";

const REFRESH_MS = 3000;
const DOME = "#/dome";
const SETUP = /^#\/setup\/([\w-]+)$/;
const LOST = "Connection lost; trying again.";

const main = find("main");
const jobs = find("jobs");
const account = find("account");
const connection = find("connection");
const domeLink = find<HTMLAnchorElement>("dome");
const list = new JobList(jobs);
const workers = find("workers");
const workerList = new WorkerList(workers);
let view: JobView | DomeView | null = null;
let listTrouble = "";
let viewTrouble = "";
let isSignedOut = false;
/** Whether the next refresh opens the address: nothing was opened yet, or what was failed in a way that may pass. */
let isViewDue = true;
let isAccountDue = true;

function showConnection(): void {
  connection.textContent = isSignedOut ? "" : listTrouble || viewTrouble;
}

function showViewConnection(open: boolean): void {
  viewTrouble = open ? "" : LOST;
  showConnection();
}

function isOfPage(hash: string): boolean {
  return hash.startsWith("#/");
}

async function refreshList(): Promise<void> {
  try {
    const newest = await list.refresh();
    listTrouble = "";
    if (isAccountDue) void showAccount();
    if (isViewDue && newest && !isOfPage(location.hash)) history.replaceState(null, "", `#/${newest}`);
    if (isViewDue) void open();
  } catch (problem) {
    if (problem instanceof Unauthenticated) askForToken();
    listTrouble = problem instanceof TypeError ? LOST : sentenceOf(problem);
  }
  showConnection();
}

async function open(): Promise<void> {
  if (!isOfPage(location.hash) || isSignedOut) return;
  leave();
  const id = location.hash.match(/^#\/(\w+)$/)?.[1] ?? "";
  const isDome = location.hash === DOME;
  list.select(id);
  if (isDome) domeLink.setAttribute("aria-current", "page");
  else domeLink.removeAttribute("aria-current");
  if (!isViewDue) main.replaceChildren();
  isViewDue = false;
  if (!id) {
    showProblem(`No job has the address ${location.hash}; choose one from the list.`);
    return;
  }
  const opened = isDome ? new DomeView(showViewConnection) : new JobView(id, () => void refreshList(), () => void showNewest(), showViewConnection);
  view = opened;
  try {
    await opened.start();
    if (view === opened) main.replaceChildren(opened.root);
  } catch (problem) {
    if (problem instanceof Unauthenticated) askForToken();
    if (view !== opened) return;
    leave();
    isViewDue = mayPass(problem);
    showProblem(isViewDue ? `${sentenceOf(problem)} Trying again.` : sentenceOf(problem));
  }
}

/** Where a job was deleted: the newest one that is left. */
async function showNewest(): Promise<void> {
  leave();
  main.replaceChildren();
  history.replaceState(null, "", "#");
  isViewDue = true;
  await refreshList();
}

function leave(): void {
  view?.stop();
  view = null;
  viewTrouble = "";
  showConnection();
}

/** A sentence that stands there already is not told again. */
function showProblem(sentence: string): void {
  if (main.textContent !== sentence) main.replaceChildren(element("p", { class: "failure", role: "alert" }, sentence));
}

function askForToken(): void {
  if (isSignedOut) return;
  isSignedOut = true;
  leave();
  hideAll();
  const form = new SignIn(() => void start());
  main.replaceChildren(form.root);
  form.root.querySelector("input")?.focus();
}

function hideAll(): void {
  jobs.hidden = true;
  domeLink.hidden = true;
  workers.hidden = true;
  account.replaceChildren();
}

async function showAccount(): Promise<void> {
  isAccountDue = false;
  let session: Session;
  try {
    session = await getSession();
  } catch (problem) {
    if (problem instanceof Unauthenticated) askForToken();
    isAccountDue = mayPass(problem);
    return;
  }
  domeLink.hidden = !session.is_open && !["admin", "operate-dome"].some((scope) => session.scopes.includes(scope));
  if (session.is_open) return;
  const button = element("button", { type: "button" }, "Sign out");
  button.addEventListener("click", () => void signOut().finally(() => location.reload()));
  account.replaceChildren(`${session.name} `, button);
}

async function start(): Promise<void> {
  const secret = location.hash.match(SETUP)?.[1];
  if (secret) {
    isSignedOut = true;
    hideAll();
    main.replaceChildren(new SetupView(secret, () => void start()).root);
    return;
  }
  isSignedOut = false;
  isViewDue = true;
  isAccountDue = true;
  jobs.hidden = false;
  workers.hidden = false;
  main.replaceChildren();
  await refreshList();
  if (isSignedOut) return;
  void workerList.refresh();
  if (isViewDue) await open();
}

find("skip").addEventListener("click", (event) => {
  event.preventDefault();
  main.focus();
});
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
