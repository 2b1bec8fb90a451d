/** The page: a list of jobs and the job that the address names. */

import { element, find } from "./element";
import { JobList } from "./jobList";
import { JobView } from "./jobView";

const REFRESH_MS = 3000;

const main = find("main");
const connection = find("connection");
const list = new JobList(find("jobs"));
let view: JobView | null = null;

function showConnection(open: boolean): void {
  connection.textContent = open ? "" : "Connection lost; trying again.";
}

async function refreshList(): Promise<void> {
  try {
    const newest = await list.refresh();
    showConnection(true);
    if (!location.hash && newest) location.replace(`#/${newest}`);
  } catch {
    showConnection(false);
  }
}

async function open(): Promise<void> {
  const id = location.hash.match(/^#\/(\w+)$/)?.[1];
  if (!id) return;
  view?.stop();
  list.select(id);
  view = new JobView(id, () => void refreshList(), showConnection);
  main.replaceChildren(view.root);
  try {
    await view.start();
  } catch (problem) {
    main.replaceChildren(element("p", { class: "failure", role: "alert" }, problem instanceof Error ? problem.message : String(problem)));
  }
}

window.addEventListener("hashchange", () => void open());
setInterval(() => {
  if (!document.hidden) void refreshList();
}, REFRESH_MS);
void refreshList().then(open);
