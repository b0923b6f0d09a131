/** The panel of comparisons: the map beside itself with another time, date, layer, style, algorithm or setting of shadows. */

import { type ComparedMap, setComparedMap } from '../compared_map';
import { html } from '../dom';
import { SCHEME } from '../map';
import { clockText } from '../moments';
import type { Panel, PanelContext } from '../panels';
import { pictureQuery } from '../query';
import { inWords, isAbort } from '../service';
import { withSetting } from '../shadow_settings';
import { LAYER_NAMES, type State } from '../state';
import { type Choice, type Kind, layerWords, otherQuery, parseChoice, sideName } from './choice';
import { Divider } from './divider';
import { OtherMap } from './other_map';
import { type Setting, shadowSettings } from './settings';
import './compare.css';

const COMPARE = 'compare';
const SPLIT = 'compare-split';

function splitIn(own: State['own']): number {
  const split = Number(own[SPLIT] ?? 0.5);
  return split >= 0 && split <= 1 ? split : 0.5;
}

/** The other side for the player of the day. */
function playable(other: OtherMap): ComparedMap {
  return {
    map: other.map,
    query: (state) => {
      const choice = parseChoice(state.own[COMPARE]);
      return choice ? otherQuery(state, choice) : pictureQuery(state);
    },
    hold: () => other.hold(),
    release: () => other.release(),
  };
}

/** The comparison stays while other panels are open: the time is moved for both maps. */
function start({ store, map, service, level }: PanelContext): void {
  let other: OtherMap | null = null;
  let divider: Divider | null = null;
  const end = () => {
    setComparedMap(null);
    other?.remove();
    divider?.remove();
    other = divider = null;
  };
  store.watch(
    (state) => {
      const choice = parseChoice(state.own[COMPARE]);
      return choice && {
        split: splitIn(state.own), left: sideName(state, choice, true), right: sideName(state, choice, false),
        tiles: SCHEME + service.tiles(level().name, otherQuery(state, choice)),
      };
    },
    (wanted) => {
      if (!wanted) {
        end();
        return;
      }
      const { split, left, right, tiles } = wanted;
      if (other) other.show(tiles);
      else {
        const made = new OtherMap(map, tiles);
        other = made;
        void made.ready().then(() => {
          if (other === made) setComparedMap(playable(made));
        });
      }
      divider ??= new Divider(
        map.getContainer(),
        (to) => store.setOwn({ [SPLIT]: to === 0.5 ? null : to.toFixed(3) }),
        () => store.setOwn({ [COMPARE]: null, [SPLIT]: null }),
      );
      other.split(split);
      divider.show(split, left, right);
    },
  );
}

function mount(container: HTMLElement, context: PanelContext): () => void {
  const { store, service, level } = context;
  const values = html('div', { class: 'values' });
  const off = html('button', { type: 'button', class: 'plain', onclick: () => store.setOwn({ [COMPARE]: null, [SPLIT]: null }) }, 'End the comparison');
  const what = html('select', { id: 'compare-what', onchange: () => begin(what.value as Kind | 'algorithm' | '') });
  container.append(
    html('p', { class: 'note' }, 'Two maps of the same ground, with a line between them that you can drag.'),
    html('label', { class: 'row', for: 'compare-what' }, 'Compare with another', what), values, off);
  const loading = new AbortController();
  let settings: readonly Setting[] | null = null;

  const choose = (name: string, value: string) => store.setOwn({ [COMPARE]: value ? `${name}:${value}` : null });

  const begin = (kind: Kind | 'algorithm' | '') => {
    const { state } = store;
    const first: Record<string, string> = {
      '': '',
      time: `time:${clockText((state.minutes + 180) % 1440)}`,
      date: `date:${state.date.slice(0, 4)}-${state.date.slice(5, 7) === '06' ? '12' : '06'}-21`,
      layer: `layer:${LAYER_NAMES.find((name) => name !== state.layer)}`,
      style: `style:${level().styles?.find((name) => name !== (state.style ?? level().style)) ?? ''}`,
      algorithm: `algorithm:${level().algorithms.find((name) => name !== state.own['plan-algorithm']) ?? ''}`,
      setting: 'filter:sun',
    };
    const text = first[kind] ?? '';
    store.setOwn({ [COMPARE]: text && parseChoice(text) ? text : null });
  };

  const show = (state: State) => {
    const choice = parseChoice(state.own[COMPARE]);
    const kinds: [string, string][] = [['', 'nothing'], ['time', 'time of day'], ['date', 'date'], ['layer', 'layer']];
    if (level().styles?.length) kinds.push(['style', 'style']);
    kinds.push(['algorithm', 'shadow algorithm'], ['setting', 'setting of shadows']);
    const kind = !choice ? '' : choice.kind === 'setting' && choice.name === 'algorithm' ? 'algorithm' : choice.kind;
    what.replaceChildren(...kinds.map(([value, text]) => html('option', { value, selected: value === kind }, text)));
    off.hidden = !choice;
    values.replaceChildren(...(choice ? fields(choice, kind, state) : []));
  };

  const fields = (choice: Choice, kind: string, state: State): Node[] => {
    const change = (value: string) => choose(choice.name, value);
    switch (kind) {
      case 'time': return [input('time', 'On the right, at', choice.value, change), said(`On the left: ${clockText(state.minutes)}, as on the dial.`)];
      case 'date': return [input('date', 'On the right, on', choice.value, change), said(`On the left: ${state.date}.`)];
      case 'layer': return [
        select('compare-right', 'On the right', LAYER_NAMES.map((name) => [name, layerWords(name)]), choice.value, change),
        said(`On the left: ${layerWords(state.layer)}.`),
      ];
      case 'style': {
        const styles = (level().styles ?? []).map((name): [string, string] => [name, name]);
        return [
          select('compare-left', 'On the left', [['', 'the level’s own'], ...styles], state.style ?? '', (value) => store.set({ style: value || null })),
          select('compare-right', 'On the right', styles, choice.value, change),
        ];
      }
      case 'algorithm': return bothSides(choice, state, level().algorithms, change);
      default: return settingFields(choice, state, change);
    }
  };

  /** Of settings both sides can be chosen: the left one is the map's own. */
  const bothSides = ({ name, value }: Choice, state: State, words: readonly string[], change: (value: string) => void): Node[] => {
    const options = words.map((word): [string, string] => [word, word.replaceAll('_', ' ')]);
    const left = state.own[`plan-${name}`] ?? '';
    return [
      select('compare-left', 'On the left', [['', 'automatic'], ...options], left, (chosen) => store.setOwn(withSetting(name, chosen || null))),
      select('compare-right', 'On the right', options, value, change),
    ];
  };

  const settingFields = (choice: Choice, state: State, change: (value: string) => void): Node[] => {
    if (!settings) {
      void shadowSettings(service, loading.signal).then((found) => {
        settings = found;
        show(store.state);
      }).catch((error: unknown) => {
        if (!isAbort(error)) values.replaceChildren(html('p', { class: 'fail' }, inWords(error)));
      });
      return [said('Asking which settings there are …')];
    }
    const known = settings.find(({ name }) => name === choice.name) ?? settings[0];
    if (!known) return [];
    return [
      select('compare-setting', 'Setting', settings.map(({ name }) => [name, name.replaceAll('_', ' ')]), known.name, (name) => {
        const next = settings?.find((each) => each.name === name);
        if (next) choose(name, next.words[0] ?? next.example);
      }),
      said(known.about),
      ...(known.words.length ? bothSides(choice, state, known.words, change) : [input('text', 'On the right', choice.value, change)]),
    ];
  };

  const end = store.watch(
    (state) => [state.own[COMPARE], state.own['plan-algorithm'], state.level, state.layer, state.style, state.date, state.minutes] as const,
    (_, state) => {
      // A field that somebody is in stays: it is the one that changes.
      if (!values.contains(document.activeElement)) show(state);
      else off.hidden = !parseChoice(state.own[COMPARE]);
    },
  );
  return () => {
    end();
    loading.abort();
  };
}

function input(type: string, label: string, value: string, changed: (value: string) => void): HTMLElement {
  const field = html('input', { type, id: 'compare-right', value, onchange: () => { if (field.value) changed(field.value); } });
  return html('label', { class: 'row', for: 'compare-right' }, label, field);
}

function select(id: string, label: string, options: readonly (readonly [string, string])[], value: string, changed: (value: string) => void): HTMLElement {
  const field = html('select', { id, onchange: () => changed(field.value) },
    ...options.map(([name, text]) => html('option', { value: name, selected: name === value }, text)));
  return html('label', { class: 'row', for: id }, label, field);
}

function said(words: string): HTMLElement {
  return html('p', { class: 'note' }, words);
}

/** What of the address's parts compares nothing. */
function faults({ [COMPARE]: text }: State['own']): string[] {
  return text === undefined || parseChoice(text) ? [] : [`${COMPARE}=${text} is not understood: as time:09:00, date:2024-06-21 or layer:shadow`];
}

export const comparePanel: Panel = { id: 'compare', title: 'Compare', start, faults, mount };
