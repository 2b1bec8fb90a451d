/**
 * One option of a job as a form field, built from its JSON schema: label, input, help with unit, and the fault of its
 * value.
 */

import { element } from "./element";

export interface OptionSchema {
  type?: string;
  anyOf?: OptionSchema[];
  enum?: (string | number)[];
  items?: { type: string };
  const?: string;
  format?: string;
  default?: unknown;
  description?: string;
  minimum?: number;
  maximum?: number;
  exclusiveMinimum?: number;
}

/** Units by the ending of an option's name. */
const UNITS: Record<string, string> = { _s: "s", _px: "px", _mm: "mm", _deg: "°" };

type Input = HTMLInputElement | HTMLSelectElement | HTMLTextAreaElement;

export class OptionField {
  readonly root: HTMLElement;
  private readonly input: Input;
  private readonly refusal: HTMLElement;
  private readonly schema: OptionSchema;
  /** The number that may stand in place of a word such as auto. */
  private readonly number: OptionSchema | undefined;

  constructor(
    readonly name: string,
    schema: OptionSchema,
    isRequired = false,
  ) {
    this.schema = { ...schema, ...(schema.anyOf?.find((one) => one.type !== "null") ?? {}) };
    const isNumber = (one: OptionSchema) => one.type === "integer" || one.type === "number";
    if (this.schema.const !== undefined) this.number = schema.anyOf?.find(isNumber);
    const id = `option-${name.replace(".", "-")}`;
    this.input = build(this.schema, id);
    if (isRequired) this.input.required = true;
    const unit = Object.entries(UNITS).find(([end]) => name.endsWith(end))?.[1];
    const label = element(
      "label",
      { for: id },
      words(name),
      unit ? element("span", { class: "soft" }, `, ${unit}`) : null,
    );
    const help = element("p", { id: `${id}-help`, class: "soft help" }, this.help());
    this.refusal = element("p", { id: `${id}-wrong`, class: "bad", role: "alert" });
    this.input.setAttribute("aria-describedby", `${help.id} ${this.refusal.id}`);
    this.root = element(
      "div",
      { class: this.schema.type === "boolean" ? "option check" : "option" },
      label,
      this.input,
      help,
      this.refusal,
    );
    this.input.addEventListener("input", () => this.accuse(""));
    this.reset();
  }

  /** Offer values, each with a few words on it; other values may still be typed. */
  suggest(values: [string, string][]): void {
    const list = element(
      "datalist",
      { id: `known-${this.input.id}` },
      ...values.map(([value, text]) => element("option", { value }, text)),
    );
    this.input.setAttribute("list", list.id);
    this.root.append(list);
  }

  reset(): void {
    this.set(this.schema.default);
  }

  set(value: unknown): void {
    if (this.input instanceof HTMLInputElement && this.input.type === "checkbox") this.input.checked = value === true;
    else if (Array.isArray(value)) this.input.value = value.join(", ");
    else if (value && typeof value === "object")
      this.input.value = Object.entries(value)
        .map(([key, one]) => `${key} = ${one}`)
        .join("\n");
    else this.input.value = value === undefined || value === null ? "" : String(value);
  }

  /** Return the value for the job; undefined where it is the default or the field is hidden. */
  value(): unknown {
    if (this.root.hidden) return undefined;
    const value = this.read();
    return JSON.stringify(value) === JSON.stringify(this.schema.default ?? null) ? undefined : value;
  }

  /** Whether the value is valid in the browser's view; if not, its message is shown beside the field. */
  check(): boolean {
    const good = Boolean(this.root.hidden) || this.input.checkValidity();
    this.accuse(good ? "" : this.input.validationMessage);
    return good;
  }

  /** Show the fault of the value beside the field; an empty text removes it. */
  accuse(sentence: string): void {
    this.refusal.textContent = sentence;
    this.input.setAttribute("aria-invalid", sentence ? "true" : "false");
  }

  /** Call a function whenever the user has changed the value. */
  onChange(act: () => void): void {
    this.input.addEventListener("change", act);
  }

  focus(): void {
    this.input.closest("details")?.setAttribute("open", "");
    this.input.focus();
  }

  private read(): unknown {
    if (this.input instanceof HTMLInputElement && this.input.type === "checkbox") return this.input.checked;
    const text = this.input.value.trim();
    if (this.schema.type === "object") return table(text);
    if (!text) return Array.isArray(this.schema.default) ? [] : null;
    if (this.schema.type === "array")
      return text
        .split(",")
        .map((part) => part.trim())
        .filter((part) => part);
    if (this.number && text !== this.schema.const) return Number.isNaN(Number(text)) ? text : Number(text);
    if (this.schema.enum?.some((one) => typeof one === "number")) return Number(text);
    return this.schema.type === "number" || this.schema.type === "integer" ? Number(text) : text;
  }

  private help(): string {
    const { type } = this.schema;
    const { minimum, maximum, exclusiveMinimum } = this.number ?? this.schema;
    const limits =
      minimum !== undefined && maximum !== undefined
        ? `${minimum} to ${maximum}`
        : minimum !== undefined
          ? `${minimum} or more`
          : exclusiveMinimum !== undefined
            ? `above ${exclusiveMinimum}${maximum === undefined ? "" : `, at most ${maximum}`}`
            : "";
    const form = type === "array" ? "names, separated by commas" : type === "object" ? "one a line" : "";
    const meaning = this.schema.description ?? "";
    const parts = [meaning && meaning[0]?.toUpperCase() + meaning.slice(1), limits, form].filter((part) => part);
    return parts.length ? `${parts.join("; ")}.` : "";
  }
}

function build(schema: OptionSchema, id: string): Input {
  if (schema.enum)
    return element("select", { id }, ...schema.enum.map((one) => element("option", { value: `${one}` }, `${one}`)));
  if (schema.type === "boolean") return element("input", { id, type: "checkbox" });
  if (schema.type === "object") return element("textarea", { id, rows: "2", spellcheck: "false" });
  const input = element("input", { id, type: "text", autocomplete: "off", spellcheck: "false" });
  if (schema.type !== "number" && schema.type !== "integer") return input;
  input.type = "number";
  input.required = schema.default !== undefined && schema.default !== null;
  input.step = schema.type === "integer" ? "1" : "any";
  if (schema.minimum !== undefined) input.min = `${schema.minimum}`;
  if (schema.maximum !== undefined) input.max = `${schema.maximum}`;
  return input;
}

/** Parse lines such as 'enamel.sigma = 4.5'. A value that is no number is sent as it is, so that the server says so. */
function table(text: string): Record<string, unknown> {
  const rows = text
    .split("\n")
    .map((line) => line.split("=").map((part) => part.trim()))
    .filter(([key]) => key);
  return Object.fromEntries(
    rows.map(([key, value]) => [key, value && Number.isFinite(Number(value)) ? Number(value) : (value ?? null)]),
  );
}

function words(name: string): string {
  if (name === "ior") return "Index of refraction";
  if (name === "fdi") return "FDI number";
  const text = (name.split(".").at(-1) ?? name).replace(/_(s|px|mm|deg)$/, "").replaceAll("_", " ");
  return text[0]?.toUpperCase() + text.slice(1);
}
