/** The workers, the task of each, and how many jobs they have finished. */

import { listWorkers, sentenceOf, type Worker } from "./api";
import { element } from "./element";
import { bytes } from "./format";

export class WorkerList {
  private readonly sentence = element("p", { class: "soft" });
  private readonly items = element("ul");

  constructor(root: HTMLElement) {
    root.append(element("h2", {}, "Workers"), this.sentence, this.items);
  }

  async refresh(): Promise<void> {
    try {
      const found = await listWorkers();
      const done = `Done: ${found.succeeded_last_hour} in the last hour, ${found.succeeded_last_day} in 24 h.`;
      this.sentence.textContent = `${found.sentence} ${done}`;
      const focused = this.items.contains(document.activeElement) ? document.activeElement?.getAttribute("href") : null;
      this.items.replaceChildren(...found.workers.map(item));
      if (focused) this.items.querySelector<HTMLElement>(`a[href="${focused}"]`)?.focus();
    } catch (problem) {
      this.sentence.textContent = sentenceOf(problem);
      this.items.replaceChildren();
    }
  }
}

function item(worker: Worker): HTMLElement {
  const tasks = worker.tasks.flatMap((task) => [
    task.job === null ? `${task.stage} of others` : element("a", { href: `#/${task.job}` }, task.stage),
    " ",
  ]);
  const doing = tasks.length > 0 ? tasks : [`${worker.fault || idle(worker)} `];
  const limit = worker.memory_limit_bytes === null ? "" : ` of ${bytes(worker.memory_limit_bytes)}`;
  const memory = element("span", { class: "soft" }, `${worker.host}, ${bytes(worker.memory_bytes)}${limit}`);
  return element("li", {}, element("strong", {}, `Worker ${worker.name}`), " ", ...doing, memory);
}

function idle(worker: Worker): string {
  if (worker.runs_stages) return "idle";
  return worker.has_dome ? "waits for captures" : "takes no tasks";
}
