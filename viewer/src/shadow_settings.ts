/** Settings of shadows in the URL (`plan-NAME`) and in queries. */

import type { Query } from './service';
import type { State } from './state';

const PREFIX = 'plan-';

/** The settings as the service's queries have them; of what the service chooses by itself there is none. */
export function settingsQuery({ own }: State): Query {
  const settings = Object.entries(own).filter(([name]) => name.startsWith(PREFIX));
  return Object.fromEntries(settings.map(([name, value]) => [name.slice(PREFIX.length), value]));
}

/** A change of the address that sets a setting; null leaves it to the service. */
export function withSetting(name: string, value: string | null): Record<string, string | null> {
  return { [PREFIX + name]: value };
}
