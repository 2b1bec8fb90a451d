/** Fitted parameters per channel, each with unit, standard error, and a flag where the data does not determine it. */

import type { Parameters } from "./api";
import { element } from "./element";
import { significant, sourcesOf, unitOf, unitOfName, valueOf } from "./format";

/**
 * Names of the parameters of single atoms, which the table leaves out: the dictionary of a slab may have a hundred
 * atoms.
 */
const OF_AN_ATOM = /^(atoms|volumes)\./;

export class ParameterTable {
  readonly root = element(
    "div",
    { class: "scroll", tabindex: "0", role: "region", "aria-label": "Parameters" },
    element("p", { class: "soft" }, "No value yet."),
  );
  private readonly current = new Map<string, Record<string, number>>();
  private isFinal = false;

  /** Show the values of a running fit. Their uncertainty is not known yet, and the table says so. */
  showStep(channel: string, values: Record<string, number>): void {
    this.current.set(channel, values);
    if (this.isFinal) return;
    const cell = (name: string, at: string) => {
      const value = this.current.get(at)?.[name];
      return [value === undefined ? "–" : significant(value)];
    };
    const names = [...new Set([...this.current.values()].flatMap(Object.keys))];
    this.fill(
      "While fitting: current values, uncertainty not known yet.",
      [...this.current.keys()],
      names,
      unitOfName,
      cell,
    );
  }

  clear(): void {
    this.current.clear();
  }

  /**
   * Show the published result.
   *
   * @param heading - returns the heading of the column of a channel.
   * @param label - returns the heading of the row of a parameter.
   */
  showResult(result: Parameters, heading: (channel: string) => string, label: (name: string) => string): void {
    this.isFinal = true;
    const channels = Object.keys(result);
    const all = [...new Set(channels.flatMap((channel) => Object.keys(result[channel] ?? {})))];
    const names = all.filter((name) => !OF_AN_ATOM.test(name));
    const unit = (name: string) => {
      const first = channels.map((channel) => result[channel]?.[name]).find((estimate) => estimate);
      return first ? unitOf(first) : "";
    };
    const left = names.length < all.length ? " Those of single atoms of the dictionary are in the report." : "";
    const hasSources = Object.values(result).some((own) => Object.values(own).some((one) => sourcesOf(one)));
    const sources = hasSources ? ", and what most of its square is made of" : "";
    this.fill(
      `Result: value ± one standard error${sources}.${left}`,
      channels,
      names,
      unit,
      (name, channel) => {
        const estimate = result[channel]?.[name];
        if (!estimate) return ["–"];
        const flag = estimate.se === null ? "not fitted" : estimate.determined ? null : "not determined";
        const sources = sourcesOf(estimate);
        return [
          valueOf(estimate),
          ...(flag ? [element("span", { class: "flag" }, flag)] : []),
          ...(sources ? [element("div", { class: "soft sources" }, sources)] : []),
        ];
      },
      heading,
      label,
    );
  }

  private fill(
    caption: string,
    channels: string[],
    names: string[],
    unit: (name: string) => string,
    cell: (name: string, channel: string) => (string | HTMLElement)[],
    heading: (channel: string) => string = (channel) => channel,
    label: (name: string) => string = (name) => name,
  ): void {
    const head = element(
      "tr",
      {},
      ...["parameter", "unit", ...channels.map(heading)].map((text) => element("th", { scope: "col" }, text)),
    );
    const rows = names.map((name) =>
      element(
        "tr",
        {},
        element("th", { scope: "row" }, ...breakable(label(name))),
        element("td", {}, unit(name)),
        ...channels.map((channel) => element("td", { class: "number" }, ...cell(name, channel))),
      ),
    );
    this.root.replaceChildren(
      element("table", {}, element("caption", {}, caption), element("thead", {}, head), element("tbody", {}, ...rows)),
    );
  }
}

/** Return a name that may be broken after its dots, so that it needs little room on a phone and no word is cut. */
function breakable(name: string): (string | HTMLElement)[] {
  return name.split(/(?<=\.)/).flatMap((part, place) => (place ? [element("wbr"), part] : [part]));
}
