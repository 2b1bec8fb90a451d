/** The live curve of a fit: loss and held-out error per channel over steps, on a logarithmic axis. */

import uPlot from "uplot";
import type { JobEvent, Verdict } from "./api";
import { element } from "./element";
import { figureOf, percent, significant } from "./format";

interface Point {
  loss: number | null;
  heldOut: number | null;
  heldOutSe: number | null;
}

const positive = (value: unknown): number | null => (typeof value === "number" && value > 0 ? value : null);

export class LossChart {
  readonly root = element("figure", { class: "chart" });
  private readonly canvas = element("div", { role: "img" });
  private readonly caption = element("figcaption", { "aria-live": "polite" }, "No step yet.");
  private readonly channels = new Map<string, Map<number, Point>>();
  private plot: uPlot | null = null;
  private plotted = "";
  private stale = false;
  private verdict: Verdict | null = null;
  private readonly resizes = new ResizeObserver(() => this.plot?.setSize(this.size()));
  private readonly scheme = matchMedia("(prefers-color-scheme: dark)");
  private readonly recolour = () => {
    this.plotted = "";
    this.draw();
  };

  constructor() {
    this.root.append(this.canvas, this.caption);
    this.resizes.observe(this.canvas);
    this.scheme.addEventListener("change", this.recolour);
  }

  stop(): void {
    this.resizes.disconnect();
    this.scheme.removeEventListener("change", this.recolour);
    this.clear();
    this.plot?.destroy();
    this.plot = null;
  }

  clear(): void {
    this.channels.clear();
  }

  /**
   * Show the result beside the curve once there is one. The renders of single steps take few paths, and their errors
   * are less certain.
   */
  conclude(verdict: Verdict | null): void {
    this.verdict = verdict;
    if (this.plot) this.draw();
  }

  /** Add a step of a channel; a step that a later attempt repeats replaces the earlier one. */
  add(name: string, event: JobEvent): void {
    const { step, loss, held_out_error: heldOut, held_out_se: heldOutSe } = event.data;
    if (typeof step !== "number") return;
    const points = this.channels.get(name) ?? new Map<number, Point>();
    this.channels.set(
      name,
      points.set(step, { loss: positive(loss), heldOut: positive(heldOut), heldOutSe: positive(heldOutSe) }),
    );
    if (!this.stale) requestAnimationFrame(() => this.draw());
    this.stale = true;
  }

  private size(): { width: number; height: number } {
    return { width: this.canvas.clientWidth || 600, height: 300 };
  }

  private draw(): void {
    this.stale = false;
    if (!this.channels.size) return;
    const names = [...this.channels.keys()];
    const steps = [...new Set([...this.channels.values()].flatMap((points) => [...points.keys()]))].sort(
      (a, b) => a - b,
    );
    const column = (points: Map<number, Point>, key: keyof Point) =>
      steps.map((step) => points.get(step)?.[key] ?? null);
    const data = [
      steps,
      ...[...this.channels.values()].flatMap((points) => [column(points, "loss"), column(points, "heldOut")]),
    ] as uPlot.AlignedData;
    if (this.plot && this.plotted === names.join()) this.plot.setData(data);
    else this.rebuild(names, data);
    this.describe(steps.length);
  }

  private rebuild(names: string[], data: uPlot.AlignedData): void {
    const style = getComputedStyle(document.documentElement);
    const colour = (name: string) => style.getPropertyValue(name).trim();
    const line = (name: string, index: number) =>
      colour(`--channel-${name.split(",")[0]}`) || colour(`--line-${index % 3}`);
    const axis = {
      stroke: colour("--text-soft"),
      grid: { stroke: colour("--grid"), width: 1 },
      ticks: { stroke: colour("--rule") },
    };
    const series = names.flatMap((name, index) => [
      { label: `${name} loss`, stroke: line(name, index), width: 2, spanGaps: true },
      {
        label: `${name} held-out error`,
        stroke: line(name, index),
        width: 2,
        dash: [6, 4],
        points: { show: true, size: 6 },
        spanGaps: true,
      },
    ]);
    this.plot?.destroy();
    this.plot = new uPlot(
      {
        ...this.size(),
        scales: { x: { time: false }, y: { distr: 3 } },
        axes: [
          { ...axis, label: "step", incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500] },
          { ...axis, label: "relative error", size: 70 },
        ],
        legend: {
          markers: { dash: (plot, index) => (plot.series[index]?.dash ? "dashed" : "solid"), fill: "transparent" },
        },
        series: [{ label: "step" }, ...series],
      },
      data,
      this.canvas,
    );
    this.plotted = names.join();
  }

  private describe(count: number): void {
    const latest = [...this.channels].map(([name, points]) => {
      const last = [...points.values()];
      const loss = last.at(-1)?.loss;
      const tested = last.findLast((point) => point.heldOut !== null);
      const error = tested?.heldOut ? `, held-out error ${percent(tested.heldOut, tested.heldOutSe)}` : "";
      return `${name}: loss ${loss ? significant(loss) : "not yet"}${error}`;
    });
    const result =
      this.verdict && Object.entries(this.verdict.channels).map(([name, error]) => `${name} ${figureOf(error)}`);
    const onTheWay = `${latest.join("; ")}. Errors on the way are of renders with few paths.`;
    const found = result ? `Result: ${this.verdict?.error_of} error ${result.join(", ")}.` : onTheWay;
    const text = `${count} steps. ${found}`;
    this.caption.textContent = text;
    this.canvas.setAttribute("aria-label", `Loss over steps, logarithmic. ${text}`);
  }
}
