/** Layers that the viewer lists: those that it describes, and the service's other products that have a legend. */

import type { Level } from './service';
import { LAYER_NAMES, type LayerName } from './state';

export interface LayerChoice {
  readonly name: LayerName;
  readonly label: string;
  readonly about: string;
}

const WORDS: Readonly<Record<string, readonly [string, string]>> = {
  color: ['Shaded', 'Relief in the light of the sun, with the shadows it casts'],
  shadow: ['Shadows', 'Shadows alone, to lie over a base map'],
  sunhours: ['Hours of sun', 'How long the sun is seen on the date'],
};

/** The layers of a level to choose from. A product of whole dates is not listed unless the viewer knows how to ask for its dates. */
export function layersOf(level: Level): readonly LayerChoice[] {
  const known = LAYER_NAMES.filter((name) => level.map_layers.includes(name)).map((name) => {
    const [label, about] = WORDS[name] ?? [name, ''];
    return { name, label, about };
  });
  const others = (level.products ?? []).filter(({ name, legend, when }) => legend && when !== 'days' && !LAYER_NAMES.includes(name));
  return [...known, ...others.map(({ name, about }) => ({ name, label: capitalised(name), about: capitalised(about) }))];
}

/** Whether the colours of a layer stand for numbers, which a legend tells. */
export function hasLegend(level: Level, layer: LayerName): boolean {
  return layer === 'sunhours' || (level.products ?? []).some(({ name, legend }) => name === layer && legend);
}

function capitalised(words: string): string {
  return words.slice(0, 1).toUpperCase() + words.slice(1);
}
