/** One job, live: updated from its stream of events, and completed from its artifacts when it ends. */

import {
  type Artifact,
  artifactUrl,
  getJob,
  getParameters,
  type Job,
  type JobDetail,
  type JobEvent,
  listArtifacts,
  mayPass,
  parameterTableUrl,
  sentenceOf,
  Unauthenticated,
} from "./api";
import { Comparison } from "./comparison";
import { element } from "./element";
import { followEvents } from "./follow";
import { badgeOf, bytes, remaining, when } from "./format";
import { JobActions } from "./jobActions";
import { LossChart } from "./lossChart";
import { ParameterTable } from "./parameterTable";
import { quantityOf, SlabView } from "./slabView";
import { StageList } from "./stageList";
import { VerdictCard } from "./verdictCard";

const ASK_AGAIN_MS = 5000;

export class JobView {
  readonly root = element("article", { class: "job" });
  private readonly state = element("span", { class: "badge", role: "status" });
  private readonly waits = element("p", { class: "soft", role: "status" });
  private readonly remaining = element("p", { class: "soft remaining" });
  private readonly failure = element("p", { class: "failure", role: "alert" });
  private readonly verdict = new VerdictCard();
  private readonly refusal = element("p", { class: "failure", role: "alert" });
  private readonly title = element("h2");
  private readonly actions: JobActions;
  private readonly report = element("a", { class: "report", target: "_blank", rel: "noopener" }, "Open the report");
  private readonly stages = new StageList();
  private readonly chart = new LossChart();
  private readonly parameters = new ParameterTable();
  private readonly parameterTable = element("a", { class: "soft", download: "" }, "As a table for a spreadsheet (CSV)");
  private readonly comparison: Comparison;
  private readonly slab: SlabView;
  private isSlab = false;
  private readonly filesRefusal = element("p", { class: "failure", role: "alert" });
  private readonly files = element("ul", { class: "files" });
  /** The tooth of a jaw that the steps fit alone; null where they fit all together, undefined before the first step. */
  private tooth: number | null | undefined;
  private areFilesDue = false;
  private isStopped = false;
  private timer = 0;
  private close: () => void = () => undefined;

  constructor(
    private readonly id: string,
    private readonly onChange: () => void,
    onDeleted: () => void,
    private readonly onConnection: (open: boolean) => void,
    mayChange: boolean,
  ) {
    this.comparison = new Comparison(id);
    this.slab = new SlabView(id);
    this.failure.hidden = true;
    this.refusal.hidden = true;
    this.filesRefusal.hidden = true;
    this.report.hidden = true;
    this.report.href = artifactUrl(id, "report.html");
    this.parameterTable.hidden = true;
    this.parameterTable.href = parameterTableUrl(id);
    const then = {
      changed: (job: Job, again: boolean) => this.changed(job, again),
      deleted: onDeleted,
      refused: (problem: unknown) => this.refuse(problem),
    };
    this.actions = new JobActions(id, then, mayChange);
  }

  /** Fill the view and follow the job until `stop`. */
  async start(): Promise<void> {
    const job = await getJob(this.id);
    if (this.isStopped) return;
    this.isSlab = job.spec.kind === "slab";
    const source = job.spec.capture ?? job.spec.rig?.mouth ?? "";
    const section = (title: string, ...content: HTMLElement[]) =>
      element("section", {}, element("h3", {}, title), ...content);
    this.root.replaceChildren(
      element("header", {}, this.title, this.state, this.report),
      element(
        "p",
        { class: "soft" },
        `${job.id} · submitted ${when(job.created_s)} · ${job.spec.rig ? "rig" : "capture"} ${source}`,
      ),
      this.waits,
      this.failure,
      this.verdict.root,
      this.refusal,
      this.actions.root,
      section("Stages", this.stages.root, this.remaining),
      ...(job.spec.kind === "calibration"
        ? []
        : [
            ...(this.isSlab
              ? [section("Fit", this.slab.progress), section("Phase function", this.slab.phases)]
              : [section("Fit", this.chart.root), section("Render and photograph", this.comparison.root)]),
            section("Parameters", this.parameters.root, this.parameterTable),
          ]),
      section("Files", this.filesRefusal, this.files),
    );
    this.show(job);
    this.follow();
    void this.showFiles();
  }

  stop(): void {
    this.isStopped = true;
    window.clearTimeout(this.timer);
    this.close();
    this.chart.stop();
  }

  private follow(): void {
    this.close();
    const end = () => {
      void this.refreshState();
      void this.showFiles();
    };
    this.close = followEvents(this.id, (event) => this.take(event), end, this.onConnection);
  }

  private take(event: JobEvent): void {
    this.stages.take(event);
    this.slab.take(event);
    if (event.kind === "step") this.takeStep(event);
    if (event.kind === "preview") this.comparison.add(event);
    if (event.kind === "finished") void this.showFiles();
    // A log message without a stage says why the job waits.
    if (event.kind === "state" || (event.kind === "log" && event.stage === null)) void this.refreshState();
  }

  /**
   * Show a step. Teeth that are fitted alone are shown one at a time, and no longer once a step fits all of them
   * together.
   */
  private takeStep(event: JobEvent): void {
    const { channel, parameters } = event.data;
    const tooth = typeof event.data["tooth"] === "number" ? event.data["tooth"] : null;
    if (this.tooth === null && tooth !== null) return;
    if (this.tooth !== tooth) {
      this.chart.clear();
      this.parameters.clear();
    }
    this.tooth = tooth;
    const name = `${typeof channel === "string" ? channel : "all"}${tooth === null ? "" : `, tooth ${tooth}`}`;
    this.chart.add(name, event);
    if (parameters && typeof parameters === "object")
      this.parameters.showStep(name, parameters as Record<string, number>);
  }

  /** Ask for the state of the job. The events are no source of it, because they begin with those of the past. */
  private async refreshState(): Promise<void> {
    try {
      const job = await getJob(this.id);
      if (this.isStopped) return;
      this.show(job);
      this.onChange();
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      if (mayPass(problem)) this.askLater();
      else this.refuse(problem);
    }
    if (this.areFilesDue) await this.showFiles();
  }

  private show(job: JobDetail): void {
    this.stages.show(job.stages);
    this.showState(job);
    this.showWaiting(job);
  }

  /** Show what a job waits for and how long it will take. No event says so, so this is asked for again. */
  private showWaiting(job: JobDetail): void {
    this.waits.hidden = job.waits_for === null;
    this.waits.textContent = job.waits_for ?? "";
    // A job that waits for other jobs may have a time range; one that waits for a person has none.
    this.remaining.hidden = job.remaining === null || (job.waits_for !== null && job.remaining.low_s === null);
    this.remaining.textContent = job.remaining ? remaining(job.remaining) : "";
    window.clearTimeout(this.timer);
    if (job.state === "QUEUED" || job.state === "RUNNING") this.askLater();
  }

  private askLater(): void {
    window.clearTimeout(this.timer);
    if (!this.isStopped) this.timer = window.setTimeout(() => void this.refreshState(), ASK_AGAIN_MS);
  }

  private showState(job: Job): void {
    this.title.textContent = job.name ? `Job ${job.number} · ${job.name}` : `Job ${job.number}`;
    this.actions.show(job);
    const { text, state } = badgeOf(job);
    this.state.textContent = text;
    this.state.dataset["state"] = state;
    this.verdict.show(job.verdict, (channel) => this.channelName(channel));
    this.chart.conclude(job.verdict);
    this.failure.hidden = job.failure === null;
    this.failure.textContent = job.failure ? `${job.failure.stage ?? "job"}: ${job.failure.message}` : "";
  }

  /** Return the name of a channel for people; a channel of a slab is a wavelength in nm. */
  private channelName(channel: string): string {
    return this.isSlab ? `${channel} nm` : channel;
  }

  private changed(job: Job, again: boolean): void {
    if (this.isStopped) return;
    this.refusal.hidden = true;
    this.showState(job);
    if (again) this.follow();
    this.onChange();
  }

  private refuse(problem: unknown): void {
    this.refusal.hidden = false;
    this.refusal.textContent = sentenceOf(problem);
  }

  /** List the files that exist so far; asks again later where the server cannot answer. */
  private async showFiles(): Promise<void> {
    this.areFilesDue = false;
    try {
      const files = await listArtifacts(this.id);
      if (this.isStopped) return;
      this.list(files);
      this.slab.list(files);
      this.parameterTable.hidden = !files.some((file) => file.path === "parameters.json");
      if (!this.parameterTable.hidden) {
        this.parameters.showResult(
          await getParameters(this.id),
          (channel) => this.channelName(channel),
          (name) => (this.isSlab ? quantityOf(name) : name),
        );
      }
      this.filesRefusal.hidden = true;
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      this.filesRefusal.hidden = false;
      this.filesRefusal.textContent = sentenceOf(problem);
      this.areFilesDue = mayPass(problem);
      if (this.areFilesDue) this.askLater();
    }
  }

  private list(files: Artifact[]): void {
    const isTop = (file: Artifact) => !file.path.includes("/");
    const shown = [...files.filter(isTop), ...files.filter((file) => file.path.startsWith("asset/"))];
    this.report.hidden = !files.some((file) => file.path === "report.html");
    this.files.replaceChildren(
      ...shown.map((file) =>
        element(
          "li",
          {},
          element("a", { href: artifactUrl(this.id, file.path), target: "_blank", rel: "noopener" }, file.path),
          ` ${bytes(file.bytes)}`,
        ),
      ),
    );
  }
}
