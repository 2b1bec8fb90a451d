/** The stages of a job with their progress. */

import type { JobEvent, Stage } from "./api";
import { element } from "./element";

interface Row {
  root: HTMLLIElement;
  bar: HTMLProgressElement;
  state: HTMLElement;
  note: HTMLElement;
}

export class StageList {
  readonly root = element("ol", { class: "stages" });
  private readonly rows = new Map<string, Row>();

  show(stages: Stage[]): void {
    for (const stage of stages) {
      const row = this.row(stage.stage);
      row.root.dataset["state"] = stage.state;
      row.state.textContent = stage.attempt > 1 ? `${stage.state}, attempt ${stage.attempt}` : stage.state;
      if (stage.message) row.note.textContent = stage.message;
      this.advance(row, stage.done, stage.state === "running");
    }
  }

  take(event: JobEvent): void {
    if (!event.stage) return;
    const row = this.row(event.stage);
    row.root.dataset["state"] = event.kind === "finished" ? "finished" : "running";
    const attempt = event.attempt > 1 ? `, attempt ${event.attempt}` : "";
    row.state.textContent = `${event.kind === "finished" ? "finished" : "running"}${attempt}`;
    if (event.message) row.note.textContent = event.message;
    if (event.done !== null || event.kind === "started") this.advance(row, event.done ?? 0, event.kind !== "finished");
  }

  private advance(row: Row, done: number, running: boolean): void {
    if (running && done === 0) row.bar.removeAttribute("value");
    else row.bar.value = done;
  }

  private row(name: string): Row {
    const known = this.rows.get(name);
    if (known) return known;
    const row = {
      bar: element("progress", { max: "1", value: "0", "aria-label": `${name} progress` }),
      state: element("span", { class: "state" }, "waiting"),
      note: element("span", { class: "soft note" }),
      root: element("li"),
    };
    row.root.append(element("strong", {}, name), row.state, row.bar, row.note);
    this.root.append(row.root);
    this.rows.set(name, row);
    return row;
  }
}
