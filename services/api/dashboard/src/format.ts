/** Formats numbers for people: an uncertain number has as many digits as its standard error allows. */

import type { Estimate, Figure, Job, TimeRange } from "./api";

const UNITS: Record<string, string> = { "1": "", "1/mm": "mm⁻¹", "per mm": "mm⁻¹", "mm^-1": "mm⁻¹", um: "µm" };

export function unitOf(estimate: Estimate): string {
  return UNITS[estimate.unit] ?? estimate.unit;
}

/**
 * Return the unit of a parameter of a running fit, whose events carry values without units: only coefficients such as
 * ``sigma`` or ``sigma_s_reduced`` have a length in their unit.
 */
export function unitOfName(name: string): string {
  return /(^|\.)sigma(_\w+)?$/.test(name) ? "mm⁻¹" : "";
}

export function valueOf(estimate: Estimate): string {
  // A value that was given and not fitted has a standard error of zero.
  if (!estimate.se) return significant(estimate.value);
  const decimals = decimalsFor(estimate.se);
  // A coefficient is not negative, so below its standard error the images give an upper limit.
  if (unitOf(estimate) === "mm⁻¹" && estimate.value >= 0 && estimate.value < estimate.se)
    return `at most ${(estimate.value + 2 * estimate.se).toFixed(decimals)} (two standard errors)`;
  return `${estimate.value.toFixed(decimals)} ± ${estimate.se.toFixed(decimals)}`;
}

const SOURCES: Record<string, string> = { light_gain: "lights", mean_cosine: "mean cosine", shape: "dentin's shape" };

/**
 * Return the sources that make up most of a standard error, as shares of its square; empty where they are not known.
 */
export function sourcesOf(estimate: Estimate): string {
  const parts = Object.entries(estimate.se_parts ?? {});
  const whole = parts.reduce((sum, [, se]) => sum + se * se, 0);
  const shares = parts.map(([name, se]): [string, number] => [SOURCES[name] ?? name, (100 * se * se) / whole]);
  return shares
    .filter(([, share]) => share >= 5)
    .map(([name, share]) => `${name} ${share.toFixed(0)} %`)
    .join(", ");
}

export function significant(value: number): string {
  return Number(value.toPrecision(4)).toString();
}

/** Return text and colour of the badge of a job. A fit that did not converge is not shown as a success. */
export function badgeOf(job: Job): { text: string; state: string } {
  if (job.state === "SUCCEEDED" && job.verdict && !job.verdict.converged)
    return { text: "not converged", state: "NOT-CONVERGED" };
  return { text: job.state.toLowerCase(), state: job.state };
}

/** Format a relative error as the report does: two digits of the standard error, at least one decimal. */
export function figureOf(figure: Figure): string {
  if (figure.se === null && figure.value === 0) return "below the noise";
  if (figure.se === null) return `${(100 * figure.value).toFixed(figure.value >= 0.01 ? 1 : 2)} %`;
  const se = 100 * figure.se;
  const decimals = se > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(se)), 1), 3) : 2;
  return relative(figure.value, figure.se, decimals);
}

/** Format a relative error; one below its standard error as an upper limit, two standard errors above it. */
function relative(value: number, se: number, decimals: number): string {
  if (value >= 0 && value < se) return `at most ${(100 * (value + 2 * se)).toFixed(decimals)} % (two standard errors)`;
  return `${(100 * value).toFixed(decimals)} ± ${(100 * se).toFixed(decimals)} %`;
}

/** Format a length as the head of the report does: to a hundredth of a millimetre. */
export function lengthOf(estimate: Estimate): string {
  return `${estimate.value.toFixed(2)}${estimate.se === null ? "" : ` ± ${estimate.se.toFixed(2)}`} ${estimate.unit}`;
}

export function percent(fraction: number, se: number | null = null): string {
  return se === null ? `${(100 * fraction).toFixed(1)} %` : relative(fraction, se, 1);
}

export function bytes(count: number): string {
  const units = ["B", "kB", "MB", "GB"];
  const power = Math.min(Math.floor(Math.log10(Math.max(count, 1)) / 3), units.length - 1);
  return `${(count / 1000 ** power).toFixed(power ? 1 : 0)} ${units[power]}`;
}

export function when(seconds: number): string {
  return new Date(1000 * seconds).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
}

/** Describe the time until a job ends. */
export function remaining(range: TimeRange): string {
  if (range.low_s === null || range.high_s === null) return `No time range: ${range.reason ?? ""}`;
  const [low, lowUnit] = duration(range.low_s);
  const [high, highUnit] = duration(range.high_s);
  const ends = `${low}${lowUnit === highUnit ? "" : ` ${lowUnit}`} to ${high} ${highUnit}`;
  return `Ends in ${ends}: 80 % range from ${range.past_jobs} past jobs.`;
}

function duration(seconds: number): [string, string] {
  if (seconds < 90) return [seconds.toFixed(0), "s"];
  const [value, unit] = seconds < 5400 ? [seconds / 60, "min"] : [seconds / 3600, "h"];
  return [value.toFixed(value < 9.95 ? 1 : 0), unit];
}

/** Two digits of the standard error. */
function decimalsFor(se: number): number {
  return se > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(se)), 0), 8) : 4;
}
