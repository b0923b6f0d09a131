/** The plan of the tiles in plain words: what is taken for each light and kind of casters, what it costs, and what was left out. */

const SUN = 'sun';
const SIGNIFICANT = { maximumSignificantDigits: 2 };

const capital = (text) => text.slice(0, 1).toUpperCase() + text.slice(1);
const aloud = (text) => text.replace(/\b[a-z]+(_[a-z]+)+\b/g, (name) => name.replaceAll('_', ' '));
const number = (value) => value.toLocaleString('en', { ...SIGNIFICANT, useGrouping: false });
const percent = (share) => `${number(100 * share)} %`;
const duration = (ms) => (ms >= 1000 ? `${number(ms / 1000)} s` : `${number(ms)} ms`);

/** What is taken, as [{name, reason}]: kinds of casters of one light with one algorithm and one reason go together. */
export function choices(plan) {
  const told = new Map(plan.reasons.map(({ name, reason }) => [name, reason]));
  const groups = new Map();
  for (const [light, kinds] of Object.entries(plan.algorithm)) {
    for (const [kind, algorithm] of Object.entries(kinds)) {
      const reason = told.get(`${light}/${kind}: ${algorithm}`) ?? '';
      const key = JSON.stringify([light, algorithm, reason]);
      groups.set(key, { light, algorithm, reason, kinds: [...(groups.get(key)?.kinds ?? []), kind] });
    }
  }
  return [...groups.values()].map(({ light, algorithm, reason, kinds }) => ({
    name: `${capital(kinds.join(' and '))}${light === SUN ? '' : ` under ${light}`} ${algorithm === 'none' ? 'casts nothing' : `by ${aloud(algorithm)}`}`,
    reason: aloud(reason),
  }));
}

/** What the plan is expected to cost, held against what was asked. */
export function expectation({ policy, predicted, target, reasons }) {
  const asked = `at most ${percent(target.max_error)} of the cast shadow wrong${target.max_ms === null ? '' : `, within ${duration(target.max_ms)}`}`;
  if (!predicted) {
    const why = reasons.find(({ name }) => name.startsWith('policy'))?.reason;
    return `${why ? `${capital(why)}. ` : ''}Time and error are not predicted; asked for: ${asked}.`;
  }
  const said = `${policy === 'measure' ? 'Measured' : 'Expected'}: ${duration(predicted.ms)} of shadow work for a block of 1024 pixels, `
    + `${percent(predicted.wrong_cast)} of the cast shadow wrong.`;
  if (target.met === null) return `${said} Asked for: ${asked}.`;
  if (target.met) return `${said} That meets the target: ${asked}.`;
  const over = [
    predicted.wrong_cast > target.max_error && `${percent(predicted.wrong_cast - target.max_error)} of the cast shadow`,
    target.max_ms !== null && predicted.ms > target.max_ms && duration(predicted.ms - target.max_ms),
  ].filter(Boolean).join(' and ');
  return `${said} That misses the target (${asked})${over && ` by ${over}`}.`;
}

/** The other lists of a plan, as [{name, reason}] whose names can be read aloud; equal reasons go together. */
export function reasoned(list) {
  const groups = new Map();
  for (const { name, reason } of list) {
    groups.set(reason, [...(groups.get(reason) ?? []), name === 'none' ? 'no shadows' : aloud(name)]);
  }
  return [...groups].map(([reason, names]) => ({ name: capital(names.join(', ')), reason: aloud(reason) }));
}

/** Shows a plan in an element's parts of the classes `taken`, `cost`, `effects`, `left-out` and `rejected`. */
export function showPlan(element, plan) {
  const part = (name) => element.querySelector(`.${name}`);
  fill(part('taken'), choices(plan));
  part('cost').textContent = expectation(plan);
  fill(part('effects'), reasoned(plan.effects));
  fill(part('left-out'), reasoned(plan.left_out));
  fill(part('rejected'), reasoned(plan.rejected));
  element.hidden = false;
}

function fill(list, items) {
  list.replaceChildren(...items.flatMap(({ name, reason }) => [
    Object.assign(document.createElement('dt'), { textContent: name }),
    Object.assign(document.createElement('dd'), { textContent: reason && `${capital(reason)}.` }),
  ]));
}
