/** What a map is compared with: the same map with one thing changed, as in the URL: `compare=algorithm:sweep`. */

import { clockText } from '../moments';
import { pictureQuery } from '../query';
import type { Query } from '../service';
import { LAYER_NAMES, type LayerName, type State } from '../state';

export type Kind = 'time' | 'date' | 'layer' | 'style' | 'setting';

export interface Choice {
  readonly kind: Kind;
  /** Of a setting of shadows: its name, as `algorithm`. */
  readonly name: string;
  readonly value: string;
}

const PLAIN: readonly Kind[] = ['time', 'date', 'layer', 'style'];

/** The choice in a text of the address; null if it is none. */
export function parseChoice(text: string | undefined): Choice | null {
  const cut = text?.indexOf(':') ?? -1;
  if (!text || cut < 1 || cut === text.length - 1) return null;
  const [name, value] = [text.slice(0, cut), text.slice(cut + 1)];
  const kind = PLAIN.find((each) => each === name) ?? 'setting';
  if (kind === 'time' && minutesIn(value) === null) return null;
  if (kind === 'date' && !/^\d{4}-\d\d-\d\d$/.test(value)) return null;
  if (kind === 'layer' && !LAYER_NAMES.some((each) => each === value)) return null;
  return { kind, name, value };
}

/** What the tiles of the other side are asked for. */
export function otherQuery(state: State, choice: Choice): Query {
  const { kind, name, value } = choice;
  switch (kind) {
    case 'time': return pictureQuery({ ...state, sunBy: 'time', minutes: minutesIn(value) ?? state.minutes });
    case 'date': return pictureQuery({ ...state, date: value });
    case 'layer': return pictureQuery({ ...state, layer: value });
    case 'style': return pictureQuery({ ...state, style: value });
    case 'setting': return { ...pictureQuery(state), [name]: value };
  }
}

/** What a side shows of what is compared, in a word or two; `own`: the map itself. */
export function sideName(state: State, compared: Choice, own: boolean): string {
  const { kind, name, value } = compared;
  switch (kind) {
    case 'time': return own ? clockText(state.minutes) : value;
    case 'date': return own ? state.date : value;
    case 'layer': return layerWords(own ? state.layer : value);
    case 'style': return own ? (state.style ?? 'own style') : value;
    case 'setting': {
      const said = own ? (state.own[`plan-${name}`] ?? 'automatic') : value;
      const words = said.replaceAll('_', ' ');
      return name === 'algorithm' ? words : `${name.replaceAll('_', ' ')} ${words}`;
    }
  }
}

/** What the two sides of a comparison call a layer. */
export function layerWords(layer: LayerName): string {
  return LAYER_WORDS[layer] ?? layer;
}

const LAYER_WORDS: Readonly<Record<string, string>> = { color: 'Shaded relief', shadow: 'Shadows', sunhours: 'Hours of sun' };

function minutesIn(text: string): number | null {
  const found = /^([01]\d|2[0-3]):([0-5]\d)$/.exec(text);
  return found ? Number(found[1]) * 60 + Number(found[2]) : null;
}
