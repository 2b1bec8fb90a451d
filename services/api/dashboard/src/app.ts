/**
 * The page: a list of jobs, and beside it the job that the address names, or the dome. Where the server asks for a
 * token, a form for it.
 */

import { getSession, mayPass, type Session, sentenceOf, signOut, Unauthenticated } from "./api";
import { DomeView } from "./domeView";
import { element, find } from "./element";
import { JobList } from "./jobList";
import { JobView } from "./jobView";
import { NEW, NewJobView, RIG, SUBMIT } from "./newJobView";
import { RigView } from "./rigView";
import { SetupView, tokenCard } from "./setupView";
import { SignIn } from "./signIn";
import { SubmitView } from "./submitView";
import { WorkerList } from "./workerList";

interface View {
  readonly root: HTMLElement;
  start: () => void | Promise<void>;
  stop: () => void;
}

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
/** This view is kept, because an upload in it goes on while another view is shown. */
const newJob = new NewJobView();
const newLink = find<HTMLAnchorElement>("new");
let view: View | null = null;
let listTrouble = "";
let viewTrouble = "";
let isSignedOut = false;
/**
 * Whether the next refresh opens the view of the address: none was opened yet, or opening it failed in a way that may
 * pass.
 */
let isViewDue = true;
let isAccountDue = true;
/** Settled once it is known what the token may do, or once the server has failed to say so. */
let accountShown: Promise<void> = Promise.resolve();
/** Number of times that an address was opened, by which an older opening gives way to a newer one. */
let openings = 0;
/** The session of this browser; null until the server has answered. */
let session: Session | null = null;
let unkept: HTMLElement | null = null;

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
    if (isAccountDue) accountShown = showAccount();
    if (isViewDue && !isOfPage(location.hash)) history.replaceState(null, "", newest ? `#/${newest}` : NEW);
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
  list.select(id);
  mark(domeLink, location.hash === DOME);
  mark(newLink, location.hash === NEW);
  if (!isViewDue) show();
  isViewDue = false;
  const hash = location.hash;
  const turn = ++openings;
  // An address may be opened while the list, after which the account is asked for, is still on its way.
  if (isAccountDue) accountShown = showAccount();
  await accountShown;
  if (turn !== openings || isSignedOut) return;
  const lacking = lackingFor(hash);
  if (lacking) {
    showProblem(lacking);
    return;
  }
  const opened = viewOf(hash, id);
  if (!opened) {
    showProblem(`No job has the address ${location.hash}; choose one from the list.`);
    return;
  }
  view = opened;
  try {
    await opened.start();
    if (view === opened) show(opened.root);
  } catch (problem) {
    if (problem instanceof Unauthenticated) askForToken();
    if (view !== opened) return;
    leave();
    isViewDue = mayPass(problem);
    showProblem(isViewDue ? `${sentenceOf(problem)} Trying again.` : sentenceOf(problem));
  }
}

/** Whether the token has a scope. While that is not known this is true, and the server refuses what it may not do. */
function may(scope: string): boolean {
  return session === null || session.is_open || session.scopes.includes("admin") || session.scopes.includes(scope);
}

/** Return why the view of an address is not shown, as all its buttons would be refused; empty if some would not. */
function lackingFor(hash: string): string {
  if (hash === DOME && !may("operate-dome"))
    return "This token may not work the dome; sign in with one that has the scope operate-dome.";
  const submits = hash === NEW || hash === RIG || hash.startsWith(`${SUBMIT}/`) || hash === SUBMIT;
  if (submits && !may("submit"))
    return (
      "This token may look at jobs and submit none; choose a job from the list, or sign in with one that " +
      "has the scope submit."
    );
  return "";
}

/** Return the view of an address; null if there is none. */
function viewOf(hash: string, id: string): View | null {
  if (hash === DOME) return new DomeView(showViewConnection, () => session);
  if (hash === NEW) return newJob;
  if (hash === RIG) return new RigView();
  const source = hash.match(/^#\/submit(?:\/(\w+))?$/);
  if (source) return new SubmitView(source[1] ?? "");
  return id
    ? new JobView(
        id,
        () => void refreshList(),
        () => void showNewest(),
        showViewConnection,
        may("submit"),
      )
    : null;
}

function mark(link: HTMLAnchorElement, isHere: boolean): void {
  if (isHere) link.setAttribute("aria-current", "page");
  else link.removeAttribute("aria-current");
}

/** Show the newest job that is left, after a job was deleted. */
async function showNewest(): Promise<void> {
  leave();
  show();
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

/** Show a problem. A sentence that is shown already is not set again, so that screen readers do not repeat it. */
function showProblem(sentence: string): void {
  if (main.textContent !== sentence) show(element("p", { class: "failure", role: "alert" }, sentence));
}

function askForToken(): void {
  if (isSignedOut) return;
  isSignedOut = true;
  leave();
  hideAll();
  const form = new SignIn(() => void start());
  show(form.root);
  form.root.querySelector("input")?.focus();
}

function hideAll(): void {
  jobs.hidden = true;
  domeLink.hidden = true;
  newLink.hidden = true;
  workers.hidden = true;
  account.replaceChildren();
}

async function showAccount(): Promise<void> {
  isAccountDue = false;
  try {
    session = await getSession();
  } catch (problem) {
    if (problem instanceof Unauthenticated) askForToken();
    isAccountDue = mayPass(problem);
    return;
  }
  domeLink.hidden = !may("operate-dome");
  newLink.hidden = !may("submit");
  if (session.is_open) return;
  const button = element("button", { type: "button" }, "Sign out");
  button.addEventListener("click", () => void signOut().finally(() => location.reload()));
  account.replaceChildren(`${session.name} `, button);
}

/** Show content in the main part, below a token that its owner has not stored yet. */
function show(...content: HTMLElement[]): void {
  main.replaceChildren(...(unkept ? [unkept] : []), ...content);
}

function showToken(token: string): void {
  const card = tokenCard(token, () => {
    unkept = null;
    card.remove();
    main.focus();
  });
  unkept = card;
  void start();
}

async function start(): Promise<void> {
  const secret = location.hash.match(SETUP)?.[1];
  if (secret) {
    isSignedOut = true;
    hideAll();
    show(new SetupView(secret, showToken).root);
    return;
  }
  isSignedOut = false;
  isViewDue = true;
  isAccountDue = true;
  session = null;
  jobs.hidden = false;
  workers.hidden = false;
  newLink.hidden = true;
  show();
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
