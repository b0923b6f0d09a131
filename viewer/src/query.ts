/** Queries of the service's pictures for a state of the page. */

import { formatMoment } from './moments';
import type { Query } from './service';
import { settingsQuery } from './shadow_settings';
import type { State } from './state';

/** The sun: a moment, or a direction; nothing where the level has other lights alone. */
export function sunQuery(state: State): Query {
  if (state.sunBy === 'none') return {};
  return state.sunBy === 'time' ? { time: formatMoment(state) } : { azimuth: state.azimuth, altitude: state.altitude };
}

/** What tiles, maps and TileJSON of the layer that is shown are asked for. */
export function pictureQuery(state: State): Query {
  if (state.layer === 'sunhours') {
    return {
      layer: 'sunhours', date: state.date, quantity: state.quantity === 'hours' ? null : state.quantity, clock: state.offset,
      color_range: state.range === 'day' ? null : state.range,
    };
  }
  const layer = state.layer === 'color' ? null : state.layer;
  return { layer, style: state.layer === 'color' ? state.style : null, ...sunQuery(state), ...settingsQuery(state) };
}
