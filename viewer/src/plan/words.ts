/** A plan in plain words: what is drawn and what is not, its cost and its algorithms. */

import { capital } from '../point/words';

export interface Named {
  readonly name: string;
  readonly reason: string;
}

export interface Plan {
  readonly policy: string;
  /** By light and kind of casters. */
  readonly algorithm: Readonly<Record<string, Readonly<Record<string, string>>>>;
  readonly effects: readonly Named[];
  readonly left_out: readonly Named[];
  readonly rejected: readonly Named[];
  readonly reasons: readonly Named[];
  readonly passes: readonly string[];
  /** In dense woods `wrong_cast` is the error of coverage. */
  readonly predicted: { readonly ms: number; readonly wrong_cast: number; readonly is_coverage?: boolean } | null;
  readonly target: { readonly max_error: number; readonly max_ms: number | null; readonly met: boolean | null };
}

const SUN = 'sun';

/** Names that say little to somebody who has not drawn shadows, by the service's own. */
const EFFECTS: Readonly<Record<string, string>> = {
  cast_shadows: 'Shadows of ridges, houses and trees',
  alpha_test: 'Light through the gaps of leaves',
  outside_casters: 'Shadows of what stands outside the picture',
  sky_view: 'Light of the sky, less of it in valleys',
  soft_edges: 'Soft edges of shadows',
  refraction: 'Bending of rays in the air',
  lamps: 'Lamps',
  haze: 'Haze',
  water: 'Water',
  snow: 'Snow',
  clouds: 'Clouds',
};

const aloud = (text: string) => text.replace(/\b[a-z]+(_[a-z]+)+\b/g, (name) => name.replaceAll('_', ' '));
const number = (value: number) => value.toLocaleString('en', { maximumSignificantDigits: 2, useGrouping: false });
const percent = (share: number) => `${number(100 * share)} %`;
const duration = (ms: number) => (ms >= 1000 ? `${number(ms / 1000)} s` : `${number(ms)} ms`);

/** Effects by names that say what is seen; equal reasons go together. */
export function effectsInWords(list: readonly Named[]): Named[] {
  return together(list.map(({ name, reason }) => ({ name: EFFECTS[name] ?? capital(aloud(name)), reason })));
}

/** Rejected algorithms; equal reasons go together. */
export function rejectedInWords(list: readonly Named[]): Named[] {
  return together(list.map(({ name, reason }) => ({ name: name === 'none' ? 'No shadows' : capital(aloud(name)), reason })));
}

function together(list: readonly Named[]): Named[] {
  const groups = new Map<string, string[]>();
  for (const { name, reason } of list) groups.set(reason, [...(groups.get(reason) ?? []), name]);
  return [...groups].map(([reason, names]) => ({ name: names.map((name, n) => (n ? name.slice(0, 1).toLowerCase() + name.slice(1) : name)).join(', '), reason: sentence(reason) }));
}

function sentence(reason: string): string {
  return reason && `${capital(aloud(withoutFiles(reason)))}.`;
}

/** A reason without the files that it cites, which nobody can follow from here; what it says of them stays. */
export function withoutFiles(reason: string): string {
  return reason.replace(/ ?\(([^()]*docs\/[^()]*)\)/g, (_, cited: string) => {
    const kept = cited.split('; ').map((part) => (part.includes('docs/') ? part.replace(/^[^:]*docs\/[\w/-]+\.md[^:]*(: )?/, '') : part)).filter(Boolean);
    return kept.length ? ` (${kept.join('; ')})` : '';
  });
}

const BY_HAND = / \((to get predictions, run skugga calibrate|skugga calibrate measures them)\)/;

/** What of the service's device is still to be measured, by its own word for it; null: nothing, or it does not say. */
const CALIBRATING: Readonly<Record<string, string>> = {
  waiting: 'The service measures it as soon as nothing is drawn',
  running: 'The service is measuring it, which takes a minute or two while nothing is drawn',
  paused: 'The service is measuring it, and goes on when nothing is drawn',
  calibrated: 'The service has measured it just now: what is drawn next goes by predictions',
  failed: 'The service could not measure it; its log says why',
};

export const isCalibrating = (calibration: string | null) => ['waiting', 'running', 'paused'].includes(calibration ?? '');

/** Whether the device is not calibrated, so that fixed rules or estimated times chose. */
export function isUncalibrated({ reasons }: Pick<Plan, 'reasons'>): boolean {
  return reasons.some(({ name, reason }) => name.startsWith('policy') && BY_HAND.test(reason));
}

/** What is taken: kinds of casters of one light with one algorithm and one reason go together. */
export function choices(plan: Pick<Plan, 'algorithm' | 'reasons'>): Named[] {
  const told = new Map(plan.reasons.map(({ name, reason }) => [name, reason]));
  const groups = new Map<string, { light: string; algorithm: string; reason: string; kinds: string[] }>();
  for (const [light, kinds] of Object.entries(plan.algorithm)) {
    for (const [kind, algorithm] of Object.entries(kinds)) {
      const reason = told.get(`${light}/${kind}: ${algorithm}`) ?? '';
      const key = JSON.stringify([light, algorithm, reason]);
      const group = groups.get(key) ?? { light, algorithm, reason, kinds: [] };
      group.kinds.push(kind);
      groups.set(key, group);
    }
  }
  return [...groups.values()].map(({ light, algorithm, reason, kinds }) => ({
    name: `${capital(kinds.join(' and '))}${light === SUN ? '' : ` under ${light}`} ${algorithm === 'none' ? 'casts nothing' : `by ${aloud(algorithm)}`}`,
    reason: sentence(reason),
  }));
}

/** The settings that were chosen, each with its reason: what `choices` has not told. */
export function settingsInWords(plan: Pick<Plan, 'reasons'>): Named[] {
  return plan.reasons.filter(({ name }) => !name.includes('/') && !name.startsWith('policy'))
    .map(({ name, reason }) => ({ name: capital(aloud(name)), reason: sentence(reason) }));
}

/** What the plan is expected to cost, held against what was asked; `calibration` is how the service stands with that of its device. */
export function expectation(
  { policy, predicted, target, reasons }: Pick<Plan, 'policy' | 'predicted' | 'target' | 'reasons'>, calibration: string | null = null,
): string {
  const asked = `at most ${percent(target.max_error)} of the cast shadow wrong${target.max_ms === null ? '' : `, within ${duration(target.max_ms)}`}`;
  const why = reasons.find(({ name }) => name.startsWith('policy'))?.reason;
  const measured = CALIBRATING[calibration ?? ''];
  const basis = measured && why ? `${why.replace(BY_HAND, '')}. ${measured}` : why;
  const basisSentence = basis ? `${capital(basis)}. ` : '';
  if (!predicted) {
    return `${basisSentence}Time and error are not predicted; asked for: ${asked}.`;
  }
  const said = `${basisSentence}${policy === 'measure' ? 'Measured' : 'Expected'}: ${duration(predicted.ms)} of shadow work for a block of 1024 pixels, `
    + (predicted.is_coverage ? `coverage off by ${percent(predicted.wrong_cast)}.` : `${percent(predicted.wrong_cast)} of the cast shadow wrong.`);
  if (target.met === null) return `${said} Asked for: ${asked}.`;
  if (target.met) return `${said} That meets the target: ${asked}.`;
  const over = [
    predicted.wrong_cast > target.max_error && `${percent(predicted.wrong_cast - target.max_error)} of ${predicted.is_coverage ? 'coverage' : 'the cast shadow'}`,
    target.max_ms !== null && predicted.ms > target.max_ms && duration(predicted.ms - target.max_ms),
  ].filter(Boolean).join(' and ');
  return `${said} That misses the target (${asked})${over && ` by ${over}`}.`;
}
