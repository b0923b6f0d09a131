/** Errors in a URL: parts that are not understood, and names that the service or a level lacks. */

import { addressFaults } from './address';
import { layersOf } from './layers';
import { panels } from './panels';
import { type Level, isPlaced } from './service';
import { shotsOf } from './stage';
import type { State } from './state';

/** In words, for the level that is shown; `said` is what was understood of the address. */
export function wrongParts(hash: string, said: Partial<State>, level: Level): string[] {
  const ids = panels().map(({ id }) => id);
  const wrong = addressFaults(hash, ids);
  const { level: name, panel, style, shot, layer, own = {} } = said;
  // What was saved for a level that is not here says nothing about another.
  if (name !== undefined && name !== level.name) return [`there is no level '${name}' here; this is ${level.title || level.name}`, ...wrong];
  const layers = layersOf(level).map((choice) => choice.name);
  const views = isPlaced(level) ? [] : shotsOf(level);
  return [
    ...wrong,
    ...panels().flatMap(({ faults }) => faults?.(own) ?? []),
    ...(panel === undefined || ids.includes(panel) ? [] : [`there is no panel '${panel}'`]),
    ...(!style || level.styles?.includes(style) ? [] : [`there is no style '${style}'`]),
    ...(!layer || layers.includes(layer) ? [] : [`this level has no layer '${layer}': ${layers.join(', ')}`]),
    ...(!shot || views.includes(shot) ? [] : [`there is no view '${shot}' to show here`]),
    ...(said.sunBy === 'time' && !isPlaced(level) ? ['there is no sun by time without a place on the earth'] : []),
  ];
}
