/** The verdict on a fit in the words and numbers of the report, shown before everything else of the job. */

import type { Verdict } from "./api";
import { element } from "./element";
import { figureOf, lengthOf } from "./format";

export class VerdictCard {
  readonly root = element("div", { class: "verdict" });
  private shown = "";

  constructor() {
    this.root.hidden = true;
  }

  /** Show a verdict; `nameOf` returns the name of a channel. */
  show(verdict: Verdict | null, nameOf: (channel: string) => string): void {
    this.root.hidden = verdict === null;
    const json = JSON.stringify(verdict);
    if (!verdict || json === this.shown) return; // an alert that is shown already is not set again
    this.shown = json;
    const thickness = verdict.enamel_thickness;
    const errors = Object.entries(verdict.channels).map(([channel, error]) => `${nameOf(channel)} ${figureOf(error)}`);
    const note =
      verdict.error_of === "held-out"
        ? errors.join(", ")
        : `${errors.join(", ")}; every image was fitted, so nothing tests the result`;
    const facts = [
      fact(
        verdict.error_of === "held-out" ? "Error on held-out images" : "Error on fitted images",
        figureOf(verdict.error),
        note,
      ),
      ...(thickness ? [fact("Enamel thickness", lengthOf(thickness), "mean over what the first camera sees")] : []),
    ];
    const trouble = element(
      "p",
      { class: verdict.converged ? "doubt" : "failure", role: "alert" },
      element("strong", {}, verdict.headline),
      ` ${verdict.advice}`,
    );
    const advice = verdict.advice ? [element("p", { class: "soft" }, verdict.advice)] : [];
    const isTrouble = verdict.doubtful || !verdict.converged;
    this.root.replaceChildren(
      ...(isTrouble ? [trouble] : []),
      element("dl", {}, ...facts),
      ...(isTrouble ? [] : advice),
    );
  }
}

function fact(name: string, value: string, note: string): HTMLElement {
  return element(
    "div",
    {},
    element("dt", {}, name),
    element("dd", {}, element("strong", {}, value), element("span", { class: "soft" }, note)),
  );
}
