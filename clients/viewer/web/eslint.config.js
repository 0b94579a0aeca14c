// Of the viewer's page; `make web` and `make test` run it.
import tseslint from "typescript-eslint";

export default tseslint.config({
  files: ["*.ts"],
  ignores: ["**/*.d.ts"],
  extends: [tseslint.configs.strictTypeChecked],
  languageOptions: { parserOptions: { projectService: true } },
  rules: {
    "one-var": ["error", "never"],
    "@typescript-eslint/restrict-template-expressions": ["error", { allowNumber: true }],
    "@typescript-eslint/no-confusing-void-expression": "off",
    "@typescript-eslint/no-unnecessary-condition": "off", // takes what others change meanwhile for what it was
    "@typescript-eslint/no-unnecessary-type-parameters": "off", // $<HTMLInputElement>("#low")
  },
});
