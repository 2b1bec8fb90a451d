/**
 * The actions of a person on one job: name, cancel, retry, download, delete, keep the calibration that it made.
 * Deleting asks first, and says what is removed.
 */

import {
  archiveUrl,
  cancelJob,
  deleteJob,
  type Job,
  type JobState,
  keepCalibration,
  listArtifacts,
  renameJob,
  retryJob,
  Unauthenticated,
} from "./api";
import { element } from "./element";
import { bytes } from "./format";

const ENDED: readonly JobState[] = ["SUCCEEDED", "FAILED", "CANCELLED"];
const LONGEST_NAME = 80;

export interface Consequences {
  /** Called when the job's state has changed; `again` says that it was queued again. */
  changed: (job: Job, again: boolean) => void;
  deleted: () => void;
  refused: (problem: unknown) => void;
}

export class JobActions {
  private readonly act = element("button", { type: "button" });
  private readonly rename = element("button", { type: "button" }, "Name…");
  private readonly keep = element("button", { type: "button" }, "Keep the calibration…");
  private readonly download = element("a", { class: "button", download: "" }, "Download all (zip)");
  private readonly remove = element("button", { type: "button", class: "danger" }, "Delete…");
  private readonly dialog = element("dialog");
  private readonly kept = element("p", { class: "soft", role: "status" });
  readonly root = element(
    "div",
    { class: "actions" },
    this.keep,
    this.act,
    this.rename,
    this.download,
    this.remove,
    this.dialog,
    this.kept,
  );
  private job: Job | null = null;

  constructor(
    private readonly id: string,
    private readonly then: Consequences,
    /** Whether the page's token may change anything; else only the download is shown. */
    private readonly mayChange: boolean,
  ) {
    this.download.href = archiveUrl(id);
    this.act.addEventListener("click", () => void this.cancelOrRetry());
    this.keep.addEventListener("click", () => this.askForCalibration());
    this.rename.addEventListener("click", () => this.askForName());
    this.remove.addEventListener("click", () => void this.askToDelete());
  }

  show(job: Job): void {
    this.job = job;
    const hasEnded = ENDED.includes(job.state);
    this.rename.hidden = !this.mayChange;
    this.keep.hidden = !this.mayChange || job.spec.kind !== "calibration" || job.state !== "SUCCEEDED";
    this.act.hidden =
      !this.mayChange || job.state === "SUCCEEDED" || job.state === "CANCELLING" || job.state === "DELETING";
    this.act.textContent = hasEnded ? "Retry" : "Cancel";
    this.remove.hidden = !this.mayChange || !hasEnded;
    this.download.hidden = !hasEnded;
  }

  private async cancelOrRetry(): Promise<void> {
    const again = this.job !== null && ENDED.includes(this.job.state);
    await this.attempt(async () => this.then.changed(await (again ? retryJob : cancelJob)(this.id), again));
  }

  private askForName(): void {
    const name = element("input", {
      id: "job-name",
      type: "text",
      maxlength: `${LONGEST_NAME}`,
      autocomplete: "off",
      value: this.job?.name ?? "",
    });
    const keep = element("button", { class: "primary" }, "Keep the name");
    this.ask(
      "Name of this job",
      [
        element("label", { for: name.id }, `A label for people, up to ${LONGEST_NAME} characters; empty for none`),
        name,
      ],
      keep,
      async () => {
        this.then.changed(await renameJob(this.id, name.value.trim() || null), false);
      },
    );
    name.select();
  }

  /** The name of a calibration can never be given another content, so a name with a date is offered. */
  private askForCalibration(): void {
    const offered = `rig-${new Date().toISOString().slice(0, 10)}`;
    const name = element("input", {
      id: "calibration-name",
      type: "text",
      required: "",
      pattern: "[A-Za-z0-9][A-Za-z0-9._\\-]{0,59}",
      autocomplete: "off",
      value: offered,
    });
    const keep = element("button", { class: "primary" }, "Keep it");
    this.ask(
      "Keep the calibration",
      [element("label", { for: name.id }, "Its name: 1 to 60 letters, digits, '.', '_' or '-'"), name],
      keep,
      async () => {
        const { name: kept, state } = await keepCalibration(this.id, name.value);
        this.kept.textContent = `Jobs name it as calibrations/${kept}. Its state: ${state}.`;
      },
    );
    name.select();
  }

  private async askToDelete(): Promise<void> {
    await this.attempt(async () => {
      const files = await listArtifacts(this.id);
      const size = files.reduce((sum, file) => sum + file.bytes, 0);
      const what =
        `Its ${files.length} files that can be downloaded (${bytes(size)}) and all else that is stored of it, ` +
        "its checkpoints, events and curves, are gone for good.";
      const capture = this.job?.spec.rig
        ? "So is the capture that it took with its rig."
        : "The capture that it was made from stays.";
      const kept = `${capture} A receipt with the number, size and digest of the files is kept.`;
      const sure = element("button", { class: "danger" }, "Delete for good");
      const called = this.job?.name ? `job ${this.job.number}, “${this.job.name}”` : `job ${this.job?.number ?? ""}`;
      this.ask(`Delete ${called}?`, [element("p", {}, what), element("p", {}, kept)], sure, async () => {
        await deleteJob(this.id);
        this.then.deleted();
      });
    });
  }

  /** Ask a question with one button to go on and one to go back; Escape goes back as well. */
  private ask(title: string, content: HTMLElement[], go: HTMLButtonElement, action: () => Promise<void>): void {
    const back = element("button", { type: "button" }, "Back");
    const form = element(
      "form",
      {},
      element("h3", { id: "question" }, title),
      ...content,
      element("p", { class: "fields" }, go, back),
    );
    back.addEventListener("click", () => this.dialog.close());
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.dialog.close();
      void this.attempt(action);
    });
    this.dialog.setAttribute("aria-labelledby", "question");
    this.dialog.replaceChildren(form);
    this.dialog.showModal();
  }

  private async attempt(action: () => Promise<void>): Promise<void> {
    try {
      await action();
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      this.then.refused(problem);
    }
  }
}
